"""Times other installed rasterizers on our scene, if they draw the same picture.

    cd docs/experiments; python -m lab.peers

A peer runs in its own process, so a crash or a deadlock of its driver is reported like any other
failure. To add a peer, write a function like ``_gausscam`` and enter it in ``PEERS``.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.types import Splats, View

SAME_PICTURE_DB = 40.0
"""Peers answer in 8 bits and end Gaussians at other radii; another camera or colour is below 25."""

LAB = Path(__file__).parents[1]
"""Where this package is imported from."""

Arrays = dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Drawing:
    """A peer that is ready to draw.

    Attributes:
        device: the peer's name of its device.
        draw: draws one frame into memory; this call is timed.
        image: converts the result of ``draw`` to (3, H, W) in [0, 1].
    """

    device: str
    draw: Callable[[], Any]
    image: Callable[[Any], NDArray[np.float32]]


def installed() -> list[str]:
    """The peers that can be imported here."""
    return [
        name for name, (needs, _) in PEERS.items() if all(find_spec(module) for module in needs)
    ]


def time_peer(
    name: str, splats: Splats, view: View, truth: Tensor, *, repeats: int, limit: float = 300
) -> dict[str, Any]:
    """Time one peer's forward pass.

    Args:
        name: one of ``installed()``.
        splats: activated, with SH degree 0, because some peers draw no more.
        view: a camera with square pixels and a black background.
        truth: (3, H, W) our picture of the same scene.
        repeats: number of timed frames, after one warm-up frame.
        limit: seconds for all frames together.

    Returns:
        name, width, height, gaussians, device, ms_median, ms_min, ms_se, psnr, failed. Times are
        None if the peer drew another picture or none; failed then has the reason.
    """
    row: dict[str, Any] = {
        "name": name,
        "width": view.width,
        "height": view.height,
        "gaussians": len(splats),
        **dict.fromkeys(("device", "ms_median", "ms_min", "ms_se", "psnr", "failed")),
    }
    with tempfile.TemporaryDirectory() as folder:
        inputs, outputs = Path(folder, "inputs.npz"), Path(folder, "outputs.npz")
        np.savez(inputs, allow_pickle=False, **_arrays(splats, view))
        command = [sys.executable, "-m", "lab.peers", "--repeats", str(repeats)]
        command += ["--child", name, str(inputs), str(outputs)]
        lab = {"PYTHONPATH": os.pathsep.join([str(LAB), os.environ.get("PYTHONPATH", "")])}
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=limit, env=os.environ | lab
            )
        except subprocess.TimeoutExpired:
            return {**row, "failed": f"no end after {limit:.0f} s"}
        if done.returncode:
            last = done.stderr.strip().splitlines()[-1:] or ["no message"]
            return {**row, "failed": f"exit code {done.returncode}: {last[0]}"}
        with np.load(outputs) as made:
            image, times = made["image"], made["times"]
            row["device"] = str(made["device"])
    squared = float(((image - truth.cpu().numpy().clip(0, 1)) ** 2).mean())
    row["psnr"] = -10 * float(np.log10(max(squared, 1e-12)))
    if row["psnr"] < SAME_PICTURE_DB:
        return {**row, "failed": f"another picture: {row['psnr']:.1f} dB"}
    row["ms_median"], row["ms_min"] = float(np.median(times)), float(times.min())
    row["ms_se"] = float(times.std(ddof=1) / len(times) ** 0.5) if len(times) > 1 else 0.0
    return row


def _arrays(splats: Splats, view: View) -> Arrays:
    given = {
        "means": splats.means,
        "scales": splats.scales,
        "rotations": splats.rotations,
        "opacities": splats.opacities,
        "dc": None if splats.sh is None else splats.sh[:, 0],
        "viewmatrix": view.viewmatrix,
    }
    plain = {name: tensor.cpu().numpy() for name, tensor in given.items() if tensor is not None}
    size = np.array([view.width, view.height, view.tan_fov_y], dtype=np.float32)
    return {**plain, "size": size}


def _gausscam(given: Arrays) -> Drawing:
    """WebGPU compute shaders, 8 bits, SH degree 0; on a CPU by Mesa's lavapipe 25 or later."""
    webgpu = import_module("gausscam.backends.webgpu")
    adapters = import_module("wgpu").gpu.enumerate_adapters_sync()
    device = next(a.info["device"] for a in adapters if a.info["backend_type"] == "Vulkan")
    width, height, tan_fov_y = given["size"]
    turn, shift = given["viewmatrix"][:3, :3].T, given["viewmatrix"][3, :3]
    unit = np.linalg.norm(given["rotations"], axis=1, keepdims=True)
    scene = {
        "xyz": given["means"],
        "rot": given["rotations"] / unit,
        "scale": given["scales"],
        "opacity": given["opacities"],
        "sh": np.ascontiguousarray(given["dc"]),
        "slots": np.zeros(0, np.int32),
        "W": np.int32(width),
        "H": np.int32(height),
        "fovy": np.float32(np.degrees(2 * np.arctan(tan_fov_y))),
        "cam_pos": (-turn.T @ shift)[None].astype(np.float32),
        # it looks along -z with y up, we along z with y down
        "cam_xmat": (turn.T * np.array([1, -1, -1]))[None].astype(np.float32),
    }
    pipeline = webgpu.Pipeline(scene, device, variant=webgpu.pick_variant(device))

    def image(frame: Any) -> NDArray[np.float32]:
        rgb: NDArray[np.uint8] = pipeline.unpack(*frame)[0][0]
        return (rgb.transpose(2, 0, 1) / 255).astype(np.float32)

    return Drawing(device, pipeline.render_frame, image)


PEERS: dict[str, tuple[tuple[str, ...], Callable[[Arrays], Drawing]]] = {
    "gausscam": (("gausscam", "wgpu"), _gausscam)
}
"""By name: the modules it needs, and how it draws."""


def _child(name: str, inputs: str, outputs: str, repeats: int) -> None:
    """Draw in this process, and write picture, times in ms and device to a file."""
    with np.load(inputs) as given:
        drawing = PEERS[name][1](dict(given))
    frame = drawing.draw()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        frame = drawing.draw()
        times.append(1e3 * (time.perf_counter() - started))
    np.savez(
        outputs, image=drawing.image(frame), times=np.array(times), device=np.array(drawing.device)
    )


def _table(sizes: Sequence[str], count: int, repeats: int) -> Iterator[str]:
    """A line for our engine and for each peer, at each size: forward, SH degree 0."""
    from fragprune_plugins.engines import create_engine
    from fragprune_plugins.types import RasterInputs
    from fragprune_plugins.workbench.bench.scene import make_scene, make_view
    from fragprune_plugins.workbench.bench.timing import Case, measure

    engine = create_engine("auto")
    scene = make_scene(count).splats()
    splats = replace(scene, sh=scene.sh[:, :1].contiguous(), sh_degree=0)
    for size in sizes:
        view = make_view(*map(int, size.split("x")))
        inputs = RasterInputs(view, splats, planes=())
        (ours,) = measure([Case("peers", inputs)], [engine], repeats=repeats)
        truth = engine.rasterize(inputs, None).image
        yield f"{size} fragprune: {ours['ms_median']:.2f} ms median, {ours['ms_min']:.2f} min"
        for name in installed():
            row = time_peer(name, splats, view, truth, repeats=repeats)
            times = f"{row['ms_median']} ms median, {row['ms_min']} min, {row['psnr']} dB from ours"
            yield f"{size} {name} ({row['device']}): {row['failed'] or times}"


@click.command(epilog=f"Peers: {', '.join(PEERS)}.")
@click.option("--size", "sizes", multiple=True, default=("640x480", "1280x960"), show_default=True)
@click.option("--gaussians", type=click.IntRange(min=1), default=100_000, show_default=True)
@click.option("--repeats", type=click.IntRange(min=2), default=9, show_default=True)
@click.option("--child", nargs=3, hidden=True, help="Draw here: a peer, its inputs, its outputs.")
def main(sizes: tuple[str, ...], gaussians: int, repeats: int, child: tuple[str, ...]) -> None:
    """Time our engine and every installed peer on the scene of ``fragprune bench``."""
    if child:
        return _child(*child, repeats)
    for line in _table(sizes, gaussians, repeats):
        click.echo(line)


if __name__ == "__main__":
    main()
