"""Conformance files for renderers that draw with per-Gaussian cutoffs.

    python docs/reference/cutoff_files.py --out DIR

writes small scenes in every carrier, the pictures that a renderer is to draw of them, and
``cutoffs.json`` with cameras and tolerances. ``docs/reference/cutoff.md`` says how to use them.
Values of the scenes are such that SPZ holds them exactly, so one picture holds for all carriers.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from torch import Tensor

from fragprune_plugins.constants import ALPHA_MAX, ALPHA_MIN, DILATION, TRANSMITTANCE_MIN, VERSION
from fragprune_plugins.files.model import Model
from fragprune_plugins.workbench.models import cutoffs, formats
from fragprune_plugins.workbench.models.formats.arrays import SH_C0, of_codes, splat_of
from fragprune_plugins.workbench.scenes.pinhole import Camera

WIDTH, HEIGHT, FOCAL = 128, 96, 120.0
SUFFIXES = (".ply", ".spz", ".sog", ".glb")
PSNR_MIN = 40.0
"""dB that a renderer's picture has to reach. Rims that fall on a pixel's centre cost the rest."""

FRAGMENTS = 0.02
"""Share by which a renderer's drawn fragments may differ: the fragments on rims."""

_DEPTH = 6.0


def _grid(codes: list[int], opacities: list[float], scales: tuple[float, float]) -> Model:
    """One Gaussian per threshold (columns) and opacity (rows), apart from each other."""
    across, down = len(codes), len(opacities)
    x, y = np.meshgrid(
        (np.arange(across) + 0.5) / across - 0.5, (np.arange(down) + 0.5) / down - 0.5
    )
    count = across * down
    xyz = np.stack([6 * x.ravel(), 4.4 * y.ravel(), 0.01 * np.arange(count) - 0.5], axis=1)
    turn = np.linspace(0, math.pi / 2, count)
    zero = np.zeros(count)
    return splat_of(
        xyz=xyz,
        colours=np.linspace(-0.4, 0.5, 3 * count).reshape(3, count).T / SH_C0,
        rest=np.zeros((count, 0, 3)),
        opacities=np.repeat(opacities, across),
        log_scales=np.log(np.tile([*scales, scales[1]], (count, 1))),
        rotations=np.stack([np.cos(turn), zero, zero, np.sin(turn)], axis=1),
        thresholds=of_codes(np.tile(np.array(codes, np.uint8), down)),
    )


def _rims() -> Model:
    """Opaque ellipses: each rim shows a threshold; the first column is neutral."""
    return _grid([0, 64, 128, 192, 224, 255], [0.99, 0.6, 0.3], (0.35, 0.14))


def _faint() -> Model:
    """Stacks of faint discs: where opacity is low the 1/255 rule decides, else the threshold."""
    discs = _grid([0, 32, 64, 96, 160, 224] * 6, [0.2, 0.06, 0.02, 0.003], (0.3, 0.3))
    column = torch.arange(len(discs)) % 6  # six times the same six columns, behind each other
    xyz = discs.xyz.clone()
    xyz[:, 0] = column - 2.5
    return replace(discs, xyz=xyz, f_dc=discs.f_dc + 2)


def _cloud() -> Model:
    """Overlapping Gaussians of all sizes, with view-dependent colours of degree 1."""
    stream = np.random.default_rng(7)
    count = 200
    return splat_of(
        xyz=stream.normal(0, 1, (count, 3)) * (1.6, 1.1, 0.8),
        colours=stream.normal(0, 0.8, (count, 3)),
        rest=stream.normal(0, 0.15, (count, 3, 3)),
        opacities=stream.uniform(0.02, 0.95, count),
        log_scales=stream.uniform(-4.5, -0.9, (count, 3)),
        rotations=stream.normal(0, 1, (count, 4)),
        thresholds=of_codes(stream.integers(0, 256, count).astype(np.uint8)),
    )


SCENES: dict[str, Callable[[], Model]] = {"rims": _rims, "faint": _faint, "cloud": _cloud}


def cameras() -> dict[str, Camera]:
    """Two cameras: in front of the scene, and turned by 20 degrees about it."""
    result = {}
    for name, degrees in (("front", 0.0), ("side", 20.0)):
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        rotation = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]], dtype=torch.float64)
        translation = torch.tensor([0, 0, _DEPTH], dtype=torch.float64)
        size = (WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
        result[name] = Camera(rotation, translation, *size)
    return result


def scene(name: str) -> Model:
    """A scene as SPZ holds it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.spz"
        formats.write(formats.named(path), path, SCENES[name]())
        return formats.read(path)


def draw(splat: Model, camera: Camera) -> tuple[Tensor, float]:
    """The oracle's picture (3, H, W) over black, and its fragments per pixel."""
    from fragprune_plugins.engines import create_engine
    from fragprune_plugins.types import RasterInputs

    with torch.no_grad():
        inputs = RasterInputs(camera.view(), splat.splats(), planes=())
        drawn = create_engine("reference").rasterize(inputs, splat.falloff)
    return drawn.image.clamp(0, 1), float(drawn.fragments_per_pixel)


def write(out: Path) -> dict[str, Any]:
    """Write all files into a folder; returns what ``cutoffs.json`` says.

    Raises:
        OutputError: the folder cannot be written.
    """
    from fragprune_plugins.workbench.figures.metrics import psnr
    from fragprune_plugins.workbench.figures.pictures import save_image
    from fragprune_plugins.workbench.models.model import writable_folder

    writable_folder(out)
    scenes: dict[str, Any] = {}
    for name in SCENES:
        splat = scene(name)
        without = splat.untruncated()
        formats.write(formats.PLY, out / f"{name}.without.ply", without)
        for suffix in SUFFIXES:
            path = out / f"{name}{suffix}"
            formats.write(formats.named(path), path, splat)
        views = {}
        for view, camera in cameras().items():
            image, fragments = draw(splat, camera)
            ignored, more = draw(without, camera)
            save_image(out / f"{name}.{view}.png", image)
            save_image(out / f"{name}.{view}.without.png", ignored)
            views[view] = {
                "picture": f"{name}.{view}.png",
                "fragments_per_pixel": round(fragments, 4),
                "without_cutoffs": {
                    "picture": f"{name}.{view}.without.png",
                    "fragments_per_pixel": round(more, 4),
                    "psnr_against_picture": round(float(psnr(ignored, image)), 2),
                },
            }
        assert splat.falloff is not None
        scenes[name] = {
            "says": (SCENES[name].__doc__ or "").strip(),
            "gaussians": len(splat),
            "files": [f"{name}{suffix}" for suffix in SUFFIXES],
            "file_without_cutoffs": f"{name}.without.ply",
            "codes": cutoffs.encode(splat.falloff).tolist(),
            "views": views,
        }
    content = {
        "format": "fragprune-cutoffs-1",
        "generator": f"fragprune {VERSION}",
        "rules": {
            "alpha_min": ALPHA_MIN,
            "alpha_max": ALPHA_MAX,
            "dilation_pixels_squared": DILATION,
            "transmittance_min": TRANSMITTANCE_MIN,
            "background": [0, 0, 0],
            "colours": "as stored, without gamma",
        },
        "tolerances": {"psnr_min": PSNR_MIN, "fragments_share": FRAGMENTS},
        "cameras": [
            {
                "id": index,
                "img_name": name,
                "width": camera.width,
                "height": camera.height,
                "position": (-camera.rotation.T @ camera.translation).tolist(),
                "rotation": camera.rotation.T.tolist(),
                "fx": camera.fx,
                "fy": camera.fy,
            }
            for index, (name, camera) in enumerate(cameras().items())
        ],
        "scenes": scenes,
    }
    (out / "cutoffs.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return content


@click.command()
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder to write into.")
def main(out: Path) -> None:
    """Write scenes, expected pictures and cutoffs.json."""
    content = write(out)
    click.echo(f"Wrote {len(content['scenes'])} scenes and cutoffs.json to {out}.")


if __name__ == "__main__":
    main()
