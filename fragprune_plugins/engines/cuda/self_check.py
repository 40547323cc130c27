"""Whether the cuda engine may be trusted on this machine: once, it is held against the oracle.

In a process of its own: a kernel that reads where it must not takes its process's GPU with it, and
one that waits forever does not return. What held is remembered beside the compiled kernels.
"""

from __future__ import annotations

import hashlib
import logging
import subprocess
import sys
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import torch

from fragprune_plugins.engines import create_engine
from fragprune_plugins.engines.cuda import kernels
from fragprune_plugins.testing import scenes
from fragprune_plugins.types import Moment, SpacetimeSplats

if TYPE_CHECKING:
    from torch import Tensor

log = logging.getLogger("fragprune")

PATIENCE: Final = 300
"""Seconds for compiling and a few small frames."""

_DISAGREES: Final = 3  # exit code


@cache
def doubt() -> str | None:
    """Why not to draw with the cuda engine here; None when it has proved itself, now or before."""
    marker = kernels.cache_folder() / f"proof-{_circumstances()}"
    if marker.exists():
        return None
    log.info("holding the cuda engine against the reference engine, once on this machine")
    why = attempt()
    if why is not None:
        log.warning("not drawing with the cuda engine: %s; see fragprune doctor", why)
        return why
    try:
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()
    except OSError:  # read-only: the next process proves it again
        log.debug("cannot remember it in %s", marker.parent)
    return None


def attempt() -> str | None:
    """Draw and learn in another process; why that does not prove the cuda engine, or None."""
    command = [sys.executable, "-m", "fragprune_plugins.engines.cuda.self_check"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        return f"no picture within {PATIENCE} s"
    if done.returncode == 0:
        return None
    if done.returncode == _DISAGREES:
        return "it draws something else than the reference engine"
    said = done.stderr.strip().splitlines()
    return said[-1] if said else f"exit code {done.returncode}"


def agrees(device: str = "cuda") -> bool:
    """Whether both engines draw the same pictures, and learn the same from them."""
    pairs = zip(_drawn("cuda", device), _drawn("reference", device), strict=True)
    # a fragment at a cut may fall to one or the other: half a per cent of the sum, not of each
    return all(bool((a - b).abs().sum() <= 5e-3 * b.abs().sum() + 1e-6) for a, b in pairs)


def _drawn(name: str, device: str) -> list[Tensor]:
    """An engine's picture, slice and gradients."""
    engine: Any = create_engine(name, device)
    made, leaves = scenes.leaves(scenes.random_scene(0, 200, 70, 50, device=device))
    thresholds = scenes.random_thresholds(0, 200, device=device).requires_grad_()
    image = engine.rasterize(made, thresholds).image
    splats: Any = made.splats
    moment = Moment(timestamp=0.4, campos=made.view.campos, sh_degree_t=0)
    cut = engine.slice(
        SpacetimeSplats(
            means=splats.means,
            opacities=splats.opacities,
            times=torch.linspace(0, 1, 200, device=device),
            scales=splats.scales,
            scales_t=torch.full((200,), 0.3, device=device),
            rotations=splats.rotations,
            rotations_r=splats.rotations.roll(1, dims=0),
            sh=splats.sh,
            sh_degree=splats.sh_degree,
        ),
        moment,
    )
    drawn = [image, cut.means, cut.cov3d, cut.opacities, cut.colors]
    torch.autograd.backward([each.square().mean() for each in drawn])
    gradients = [leaf.grad for leaf in (*leaves.values(), thresholds) if leaf.grad is not None]
    return [each.detach() for each in drawn] + gradients


def _circumstances() -> str:
    """Names everything that a proof holds for."""
    compiler = kernels.compiler()
    gpu = torch.cuda.get_device_properties(torch.cuda.current_device())
    what = (compiler.name, compiler.version, torch.__version__, torch.version.cuda, str(gpu))
    digest = hashlib.sha256(kernels.digest_of_sources() + repr(what).encode())
    return digest.hexdigest()[:24]


if __name__ == "__main__":
    sys.exit(0 if agrees() else _DISAGREES)
