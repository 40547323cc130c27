""".splat, of antimatter15's viewer: 32 bytes a Gaussian, without header, SH or thresholds.

xyz 3 float32, standard deviations 3 float32, r g b opacity 4 uint8, quaternion w x y z 4 uint8
(128 + 128 q).
"""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from fragprune_plugins.files.model import Model
from fragprune_plugins.files.reading import Reading
from fragprune_plugins.workbench.models.formats import Format, arrays

_ROW = np.dtype([("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rot", "u1", 4)])


def read(reading: Reading) -> Model:
    """The Gaussians of an open file."""
    if reading.size % _ROW.itemsize:
        raise EOFError(f"{reading.size} bytes are no multiple of {_ROW.itemsize}")
    data = np.frombuffer(reading.take(reading.size), _ROW)
    rgba = data["rgba"] / np.float32(255)
    return arrays.splat_of(
        xyz=data["xyz"],
        colours=(rgba[:, :3] - 0.5) / arrays.SH_C0,
        rest=np.zeros((len(data), 0, 3)),
        opacities=rgba[:, 3],
        log_scales=arrays.logs_of(data["scale"]),
        rotations=(data["rot"].astype(np.float32) - 128) / 128,
    )


def write(file: BinaryIO, splat: Model) -> None:
    """Write the Gaussians; the registry has refused thresholds."""
    data = np.zeros(len(splat), _ROW)
    data["xyz"] = arrays.array(splat.xyz)
    data["scale"] = np.exp(arrays.array(splat.scaling))
    data["rgba"][:, :3] = arrays.byte(255 * (0.5 + arrays.SH_C0 * arrays.array(splat.f_dc)[:, 0]))
    data["rgba"][:, 3] = arrays.byte(255 * arrays.opacities_of(splat))
    data["rot"] = arrays.byte(128 + 128 * arrays.quaternions_of(splat))
    file.write(data.tobytes())


FORMAT = Format(
    "splat",
    ".splat",
    read,
    write,
    keeps="positions and scales as they are, opacities, colours and rotations to 8 bits, no SH "
    "but the base colour, and no cutoffs",
)
