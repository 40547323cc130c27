"""nerfstudio-project/nerfstudio: its method splatfacto, whose Gaussians gsplat draws.

``ns-train fragprune-splatfacto`` is splatfacto with stage 2 as its last iterations. ``method``
tells nerfstudio of it, ``model`` is its model: there a session begins, so that every tool of
nerfstudio that loads the model (``ns-eval``, ``ns-export``, ``ns-render``, the viewer) has the
thresholds.

Importing this module imports no nerfstudio; only nerfstudio's own entry point does.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fragprune_gsplat import DRAWN, LPIPS, Gsplat
from fragprune_plugins.adapting import (
    GROUPS,
    AlignmentError,
    Dialect,
    Finding,
    HostAdapter,
    HostInfo,
    HostRepo,
    Role,
    Seam,
    SeamCall,
)

if TYPE_CHECKING:
    from torch import Tensor

log = logging.getLogger("fragprune")
PACKAGE = "nerfstudio"
METHOD = "fragprune-splatfacto"
SPLATFACTO = f"{PACKAGE}.models.splatfacto"
MODEL = "fragprune_nerfstudio.model"
KEYS = ("means", "features_dc", "features_rest", "opacities", "scales", "quats")
NAMES = {key: group.name for key, group in zip(KEYS, GROUPS, strict=True)}
"""What the rest of the field calls splatfacto's keys."""
BEGIN, EXPORT = "FragpruneSplatfacto.begin_stage2", "ExportGaussianSplat.write_ply"
WRITTEN = ("filename", "count", "map_to_tensors")


def optimizers(call: SeamCall) -> list[Any]:
    """The optimizers, one for each group; the one of the means first."""
    known = call.arguments["optimizers"].optimizers
    return [known["means"], *(each for name, each in known.items() if name != "means")]


def exported(call: SeamCall) -> tuple[Path, Tensor]:
    """The exported PLY, and the model's rows that are in it; none of a model without thresholds.

    A file that holds other Gaussians than the model is removed: AlignmentError.
    """
    import torch

    from fragprune_nerfstudio.exporting import rows_exported
    from fragprune_plugins.injection.session import active_session

    path, columns = Path(call.arguments["filename"]), call.arguments["map_to_tensors"]
    session = active_session()
    model = session.last() if session is not None and session.last is not None else None
    if model is None:
        return path, torch.arange(0)
    try:
        rows = rows_exported(model.gauss_params, columns)
    except AlignmentError:
        path.unlink(missing_ok=True)
        raise
    if (mode := model.config.rasterize_mode) != "classic":
        said = "%s: trained %s; fragprune's commands draw it as 3DGS does, as other viewers do"
        log.warning(said, path, mode)
    return path, rows


class Nerfstudio(HostAdapter):
    """The adapter of nerfstudio's splatfacto."""

    name = "nerfstudio"
    info = HostInfo(
        "nerfstudio",
        repo="nerfstudio-project/nerfstudio",
        states="1.1.5 with gsplat 1.4: `splatfacto`",
        limits=(
            "Refused: several GPUs, mixed precision; on a CPU densification follows plain "
            "gradients, because our engines have no absolute gradients per axis.",
            "`ns-render` and `ns-viewer` draw with thresholds; other exports than gaussian-splat "
            "and other viewers know none.",
        ),
        usage=f"ns-train {METHOD} ...",
    )
    installed = (PACKAGE,)
    seams = (
        # of ours: called where the iteration comes at which stage 2 begins
        Seam(Role.ATTACH, MODEL, BEGIN, ("optimizers",), external=True, how=optimizers),
        Seam(Role.STEP, SPLATFACTO, "SplatfactoModel.step_cb", ("optimizers", "step")),
        Seam(Role.VIEW, SPLATFACTO, "SplatfactoModel.get_outputs", ("camera",)),
        # gsplat's function under the name by which the model calls it
        Seam(Role.RASTERIZE, SPLATFACTO, "rasterization", DRAWN, external=True),
        Seam(Role.LOSS, "torch", "Tensor.backward", external=True),
        LPIPS,
        Seam(Role.PACK, f"{PACKAGE}.scripts.exporter", EXPORT, WRITTEN, how=exported),
    )

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """Check that this is the installed package, and that gsplat is installed beside it."""
        found = super().fingerprint(repo)
        alone = repo.package and HostRepo.installed("gsplat") is None
        absent = Finding.error("other-host", repo.root, "no gsplat beside it", "gsplat 1.4")
        return [*found, *([absent] if alone else [])]

    def dialect(self, repo: HostRepo) -> Dialect:
        """That of the installed gsplat."""
        from fragprune_nerfstudio.dialect import NerfstudioDialect

        gsplat = Gsplat().dialect(HostRepo.installed("gsplat") or repo)
        return NerfstudioDialect(**vars(gsplat))

    def trainer(self, repo: HostRepo, script: Path) -> Callable[..., Any] | None:
        """What runs our method in place of splatfacto, for ns-train."""
        from fragprune_nerfstudio import command, running

        if script != repo.root / PACKAGE / "scripts" / "train.py":
            return None
        rewritten = partial(command.rewritten, METHOD)
        return partial(running.run, self.name, repo, rewritten, "ns-eval --load-config CONFIG")

    def group_name(self, model: Any, group: Mapping[str, Any]) -> str | None:
        """By the parameter; None for cameras and bilateral grids."""
        own = {id(each): name for name, each in model.gauss_params.items()}
        return next((NAMES.get(own.get(id(each), "")) for each in group["params"]), None)

    def means(self, model: Any) -> Tensor:
        """(N, 3) the parameter itself."""
        means: Tensor = model.gauss_params["means"]
        return means

    def opacities(self, model: Any) -> Tensor:
        """(N,) after the sigmoid."""
        opacities: Tensor = model.gauss_params["opacities"]
        return opacities.detach().sigmoid().reshape(-1)

    def view(self, camera: Any) -> int:
        """A key from the camera's pose, the same in every process, because checkpoints keep it."""
        pose = camera.camera_to_worlds.detach().cpu().numpy().tobytes()
        return int.from_bytes(hashlib.blake2b(pose, digest_size=7).digest(), "big")
