"""Films of a splat: a camera that goes around it or through given ones, written as MP4."""

from __future__ import annotations

import importlib
import math
import subprocess
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from fragprune_plugins.errors import OutputError, UsageError
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.files.model import Model
from fragprune_plugins.workbench.figures.pictures import picture
from fragprune_plugins.workbench.figures.viewing import overview
from fragprune_plugins.workbench.scenes.generated import Named, bounds, interpolate, moved
from fragprune_plugins.workbench.scenes.pinhole import look_at

_COLOURS = [
    "-vf",
    "scale=out_color_matrix=bt709:out_range=tv,"
    "setparams=range=tv:colorspace=bt709:color_primaries=bt709:color_trc=iec61966-2-1",
    *("-color_range", "tv", "-colorspace", "bt709"),
    *("-color_primaries", "bt709", "-color_trc", "iec61966-2-1"),
]
"""Of ffmpeg. By itself it writes those of BT.601, and does not say so; players take films of 720
rows for BT.709, and show greens and reds 20 levels of 255 off. They are said twice: ffmpeg 4 does
not hear the filter, and 9 not all of the options."""

_PICTURE: dict[str, Any] = {"width": 1280, "height": 720, "fov_y": 50.0}


def orbit(splat: Model, count: int, up: tuple[float, float, float]) -> Named:
    """Cameras once around a splat, from ``overview``'s height and distance, evenly spaced."""
    first = overview(splat, up, **_PICTURE)
    centre, _ = bounds(splat)
    shape = _PICTURE | {"fov_y": math.degrees(2 * math.atan(first.tan_fov_y))}
    axis = torch.nn.functional.normalize(torch.tensor(up, dtype=torch.float64), dim=0)
    away = first.campos.double() - centre.double()
    turns = (2 * math.pi * number / count * axis for number in range(count))
    around = (Rotation.from_rotvec(turn.numpy()).apply(away.numpy()) for turn in turns)
    eyes = [(centre.double() + torch.from_numpy(each)).float() for each in around]
    return [(f"orbit{n:04d}", look_at(eye, centre, up, **shape)) for n, eye in enumerate(eyes)]


def along(cameras: Named, count: int) -> Named:
    """Cameras through given ones, in their order, at an even pace, with the lens of the first."""
    views = [moved(cameras[0][1], view.viewmatrix, view.campos) for _, view in cameras]
    found = []
    for number in range(count):
        at = number / max(1, count - 1) * (len(views) - 1)
        begin = min(int(at), max(0, len(views) - 2))
        end = min(begin + 1, len(views) - 1)
        view = interpolate(views[begin], views[end], at - begin)
        found.append((f"frame{number:04d}", view))
    return found


def require_encoder() -> ModuleType:
    """The package that writes films; UsageError if it is not installed."""
    try:
        return importlib.import_module("imageio_ffmpeg")
    except ImportError as error:
        found = "a film, and imageio-ffmpeg is not installed"
        expected = "the package imageio-ffmpeg, which writes films"
        remedy = "pip install 'fragprune-plugins[video]', or name a folder for pictures."
        raise UsageError("--out", found, expected, remedy) from error


def write_mp4(path: Path, frames: Iterable[Tensor], fps: int) -> None:
    """Write pictures as an H.264 film, whole or not at all; OutputError if it cannot be.

    Frames are (3, H, W) RGB in [0, 1], all of one size. A side of odd length loses its last row or
    column, because H.264 halves the colours' sides.
    """
    encoder = require_encoder()
    with replacing(path) as temporary:
        writer = None
        try:
            for frame in frames:
                even = frame[:, : frame.shape[1] // 2 * 2, : frame.shape[2] // 2 * 2]
                shown = picture(even)
                if writer is None:
                    how = {"macro_block_size": 2, "quality": 8, "output_params": _COLOURS}
                    writer = encoder.write_frames(str(temporary), shown.size, fps=fps, **how)
                    writer.send(None)
                writer.send(shown.tobytes())
            if writer is not None:
                writer.close()
                opening = ["-v", "error", "-i", str(temporary), "-t", "0", "-f", "null", "-"]
                words = [encoder.get_ffmpeg_exe(), *opening]
                opened = subprocess.run(words, stdin=subprocess.DEVNULL)
                if opened.returncode:  # the writer does not say how it ended
                    raise OSError("it cannot be opened")
        except OSError as error:
            found = f"not written to its end ({str(error).strip().splitlines()[0][:200]})"
            remedy = "Check the place and its space; ffmpeg said more on stderr."
            raise OutputError(str(path), found, "a film", remedy) from error
        finally:
            if writer is not None:
                writer.close()
