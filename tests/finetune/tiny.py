"""A scene of a few Gaussians, drawn by our engine, written to disk by small writers of its own."""

import json
import math
import struct
from argparse import Namespace
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import count as counting
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from fragprune_plugins import Model, ThresholdStore, rasterize
from fragprune_plugins.workbench.figures import evaluate
from fragprune_plugins.workbench.finetune import faster, loop
from fragprune_plugins.workbench.models.formats.ply import write_ply
from fragprune_plugins.workbench.scenes.dataset import Dataset, Photograph
from fragprune_plugins.workbench.scenes.pinhole import Camera

SIDE = 32
FOCAL = 36.0


def random_model(count: int = 60, degree: int = 1, seed: int = 0) -> Model:
    """Opaque, overlapping Gaussians around the origin."""
    stream = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=stream)

    return Model(
        xyz=0.5 * normal(count, 3),
        f_dc=0.8 * normal(count, 1, 3),
        f_rest=0.1 * normal(count, (degree + 1) ** 2 - 1, 3),
        opacity=0.5 + 0.5 * normal(count, 1),
        scaling=-1.6 + 0.2 * normal(count, 3),
        rotation=normal(count, 4),
    )


def round_ones(xyz: torch.Tensor, size: float, opacity: float = 0.95) -> Model:
    """Grey Gaussians at (N, 3) places, of one size and opacity."""
    count = len(xyz)
    return Model(
        xyz=xyz.float(),
        f_dc=torch.zeros(count, 1, 3),
        f_rest=torch.zeros(count, 0, 3),
        opacity=torch.full((count, 1), opacity).logit(),
        scaling=torch.full((count, 3), math.log(size)),
        rotation=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
    )


NAMES = [f"view{i:02d}" for i in range(9)]
"""Of the photographs that are written."""


def stems(shots: Iterable[Any]) -> list[str]:
    """Names without folder and ending."""
    return [Path(shot.name).stem for shot in shots]


def cameras(count: int = 9) -> list[Camera]:
    """On a circle around the origin, looking at it; y is down."""
    result, half = [], SIDE / 2
    for i in range(count):
        cos, sin = (turn(2 * math.pi * i / count) for turn in (math.cos, math.sin))
        rotation = torch.tensor([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]], dtype=torch.float64)
        translation = torch.tensor([0.0, 0.1, 3.0], dtype=torch.float64)
        result.append(Camera(rotation, translation, SIDE, SIDE, FOCAL, FOCAL, half, half))
    return result


def host_cameras(chosen: list[Camera]) -> list[dict[str, Any]]:
    """The content of the cameras.json that a host writes."""
    return [
        {
            **{"id": i, "img_name": f"view{i:02d}", "width": each.width, "height": each.height},
            "position": (-each.rotation.T @ each.translation).tolist(),
            **{"rotation": each.rotation.T.tolist(), "fx": each.fx, "fy": each.fy},
        }
        for i, each in enumerate(chosen)
    ]


def photographs(model: Model) -> list[torch.Tensor]:
    """The model as the cameras see it, (3, H, W) each."""
    with torch.no_grad():
        return [rasterize(model, camera.view()).image.clamp(0, 1) for camera in cameras()]


def save_png(path: Path, image: torch.Tensor) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    array = np.round(255 * image.permute(1, 2, 0).numpy()).astype(np.uint8)
    Image.fromarray(array).save(path)


def quaternion(rotation: torch.Tensor) -> list[float]:
    """w, x, y, z of a rotation about the y axis."""
    angle = math.atan2(float(rotation[0, 2]), float(rotation[0, 0]))
    return [math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0]


def write_colmap(folder: Path, images: list[torch.Tensor], *, binary: bool = False) -> Path:
    """images/ and sparse/0 in COLMAP's own format, with a camera of its model PINHOLE."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    parameters = [FOCAL, FOCAL, SIDE / 2, SIDE / 2]
    poses = [
        (f"view{i:02d}.png", quaternion(camera.rotation), camera.translation.tolist())
        for i, camera in enumerate(cameras())
    ]
    for (name, _, _), image in zip(poses, images, strict=True):
        save_png(folder / "images" / name, image)
    poses.reverse()  # readers must sort
    if binary:
        with open(sparse / "cameras.bin", "wb") as file:
            file.write(struct.pack("<QiiQQ4d", 1, 7, 1, SIDE, SIDE, *parameters))
        with open(sparse / "images.bin", "wb") as file:
            file.write(struct.pack("<Q", len(poses)))
            for i, (name, q, t) in enumerate(poses):
                file.write(struct.pack("<i7di", i + 1, *q, *t, 7) + name.encode() + b"\0")
                file.write(struct.pack("<Q", i % 3))
                for _ in range(i % 3):
                    file.write(struct.pack("<ddq", 1.0, 2.0, -1))
    else:
        numbers = " ".join(repr(p) for p in parameters)
        (sparse / "cameras.txt").write_text(f"# cameras\n7 PINHOLE {SIDE} {SIDE} {numbers}\n")
        lines = ["# images"]
        for i, (name, q, t) in enumerate(poses):
            lines.append(" ".join(map(str, [i + 1, *q, *t, 7, name])))
            lines.append("1.0 2.0 -1" if i % 2 else "")
        (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def transforms(names: list[str], chosen: list[Camera]) -> dict[str, object]:
    """The content of a transforms file."""
    frames = []
    for name, camera in zip(names, chosen, strict=True):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = camera.rotation.T @ torch.diag(torch.tensor([1.0, -1, -1]).double())
        pose[:3, 3] = -camera.rotation.T @ camera.translation
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    return {"camera_angle_x": 2 * math.atan(SIDE / (2 * FOCAL)), "frames": frames}


def write_path(path: Path, names: list[str], width: int = 20, height: int = 12) -> Path:
    """A transforms file of the first cameras, as a path for a film is one."""
    content = transforms(names, cameras()[: len(names)]) | {"w": width, "h": height}
    path.write_text(json.dumps(content))
    return path


def write_blender(folder: Path, images: list[torch.Tensor]) -> Path:
    """transforms_train.json and transforms_test.json, held-out views as COLMAP's reader takes."""
    for part in ("train", "test"):
        chosen = [i for i in range(len(images)) if (i % 8 == 0) == (part == "test")]
        for i in chosen:
            save_png(folder / part / f"{NAMES[i]}.png", images[i])
        content = transforms(
            [f"./{part}/{NAMES[i]}" for i in chosen], [cameras()[i] for i in chosen]
        )
        (folder / f"transforms_{part}.json").write_text(json.dumps(content))
    return folder


def scene(folder: Path) -> tuple[Path, Path, Model]:
    """A COLMAP folder and a model whose opacities are off: data, model file, the model."""
    truth = random_model()
    data = write_colmap(folder / "data", photographs(truth))
    model = perturbed(truth)
    path = folder / "model.ply"
    write_ply(path, model)
    return data, path, model


def perturbed(truth: Model) -> Model:
    noise = torch.randn(truth.opacity.shape, generator=torch.Generator().manual_seed(1))
    return replace(truth, opacity=truth.opacity + 0.7 * noise)


def cut(model: Model, thresholds: torch.Tensor | float) -> Model:
    """The same Gaussians with thresholds (N,), or one for all."""
    values = torch.as_tensor(thresholds).expand(len(model))
    return replace(model, thresholds=ThresholdStore.from_falloff(values))


def state(model: Model) -> dict[str, torch.Tensor]:
    """All tensors of a model, those of its thresholds with their moments among them."""
    store = model.thresholds
    learned = {} if store is None else store.state_dict()
    return model.tensors | {name: torch.as_tensor(each) for name, each in learned.items()}


def dataset_in_memory(folder: Path, truth: Model) -> Dataset:
    """The dataset without a reader in between."""
    shots = []
    for i, (camera, image) in enumerate(zip(cameras(), photographs(truth), strict=True)):
        path = folder / f"{i}.png"
        save_png(path, image)
        shots.append(Photograph(f"view{i:02d}", camera.view(), path))
    return Dataset([s for i, s in enumerate(shots) if i % 8], shots[::8])


def at_loss(patch: pytest.MonkeyPatch, number: int, event: Any) -> None:
    """In the midst of a step of a fine-tuning: raise an exception's class, or call a function."""
    loss, steps = loop.photometric_loss, counting(1)

    def counted(*args: Any) -> torch.Tensor:
        if next(steps) == number:
            if isinstance(event, type):
                raise event
            event()
        return loss(*args)

    patch.setattr(loop, "photometric_loss", counted)


def exact_clock(patch: pytest.MonkeyPatch, base: float = 0.02) -> None:
    """Frames take so many ms, and 0.002 for each fragment of a pixel."""

    def timed(work: Callable[[], Any], device: torch.device) -> tuple[Any, float]:
        outputs = work()
        return outputs, base + 2e-3 * float(outputs.fragments_per_pixel)

    patch.setattr(evaluate, "timed", timed)
    patch.setattr(faster, "_SECONDS", 0.0)


def host_output(folder: Path, data: Path, model: Model, **arguments: object) -> Path:
    """What a 3DGS host leaves: models of two iterations, its arguments and its cameras."""
    for iteration in (900, 10_000):
        place = folder / "point_cloud" / f"iteration_{iteration}"
        place.mkdir(parents=True)
        write_ply(place / "point_cloud.ply", model)
    known = {"sh_degree": 1, "source_path": str(data), "images": "images", "resolution": -1}
    known |= {"white_background": False, "eval": True, "data_device": "cuda"} | arguments
    (folder / "cfg_args").write_text(str(Namespace(**known)))
    every = host_cameras(cameras())
    (folder / "cameras.json").write_text(json.dumps([*every[::8], *every[1:8]]))
    return folder
