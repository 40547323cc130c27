"""The file formats of models: one registry, from which every command reads and writes.

A file is read by the suffix of its name; a name without a suffix of ours counts as a PLY. A format
is a module with ``read`` and ``write``. To add one, write the module and a line in ``FORMATS``.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fragprune_plugins.errors import ModelFileError, OutputError
from fragprune_plugins.files.reading import Door

if TYPE_CHECKING:
    from fragprune_plugins.files.model import Model


@dataclass(frozen=True)
class Format:
    """A file format of models.

    Attributes:
        name: for messages.
        suffix: the end of a file's name.
        module: of this package, with ``read(reading) -> Model`` and ``write(file, model)``; "" for
            PLY.
        carries: whether a file can hold thresholds.
        keeps: what of a model the format keeps, as words for the user; "" if it keeps every bit.
    """

    name: str
    suffix: str
    module: str
    carries: bool
    keeps: str = ""

    @property
    def paired(self) -> bool:
        """Whether a sidecar holds the thresholds of this format's files."""
        return not self.module


PLY = Format("PLY", ".ply", "", carries=True)
COMPRESSED_PLY = Format(
    "compressed PLY",
    ".compressed.ply",
    "compressed_ply",
    carries=False,
    keeps="positions and scales to 10 or 11 bits of the range of each 256 Gaussians, rotations to "
    "10 bits, opacities, colours and SH to 8 bits, and no thresholds",
)
SOG = Format(
    "SOG",
    ".sog",
    "sog",
    carries=True,
    keeps="positions to 16 bits of their logarithm, rotations and opacities to 8 bits, scales "
    "and colours to 256 values each, SH to a palette of up to 65,536, and thresholds to 8 bits",
)
FORMATS = (
    COMPRESSED_PLY,  # before PLY, whose suffix it shares
    PLY,
    Format(
        "SPZ",
        ".spz",
        "spz",
        carries=True,
        keeps="positions to 1/4096 of a unit, scales, opacities and colours to 8 bits, rotations "
        "to 9 bits and sign, SH to 5 bits (degree 1) and 4 bits, and thresholds to 8 bits",
    ),
    SOG,
    Format(
        "splat",
        ".splat",
        "splat",
        carries=False,
        keeps="positions and scales as they are, opacities, colours and rotations to 8 bits, no SH "
        "but the base colour, and no thresholds",
    ),
    Format("GLB", ".glb", "glb", carries=True, keeps="all values and thresholds as float32"),
)

SUFFIXES = (".ply", *(each.suffix for each in FORMATS if each is not PLY))
"""The end of the name of every file that is read and written."""

ENDINGS = tuple(each for each in SUFFIXES if each != COMPRESSED_PLY.suffix)
"""The last suffixes of such names; that of a compressed PLY is .ply."""

_DOOR = Door(
    ModelFileError,
    "not readable",
    "a complete trained splat",
    "The file is of another kind or was cut off: copy or save it again.",
    missing="Pass a trained splat: " + ", ".join(SUFFIXES) + ".",
)


def named(path: Path) -> Format:
    """The format that a file to write gets by its name.

    Raises:
        OutputError: no format has this suffix.
    """
    for each in FORMATS:
        if path.name.lower().endswith(each.suffix):
            return each
    raise OutputError(
        str(path), "not the name of a model", "a name in " + ", ".join(SUFFIXES), "Rename it."
    )


def found(path: Path) -> Format:
    """The format of a file to read: by its name, and for a PLY by its header."""
    from fragprune_plugins.workbench.models.formats import compressed_ply

    if compressed_ply.lies_at(path):
        return COMPRESSED_PLY
    if path.name == "meta.json":  # of a SOG that is not bundled
        return SOG
    others = (each for each in FORMATS if not each.suffix.endswith(".ply"))
    return next((each for each in others if path.name.lower().endswith(each.suffix)), PLY)


def read(path: Path, *, filtered: bool = False) -> Model:
    """Read a model of any format; thresholds that the file itself holds are in the result.

    Args:
        path: the file.
        filtered: accept a PLY that the caller draws by its host's rules, as ``read_ply`` does.

    Raises:
        ModelFileError: missing, truncated, of another kind, empty or not finite.
    """
    from fragprune_plugins.files.ply import expect_drawable, read_ply

    form = found(path)
    if form.paired:
        return read_ply(path, filtered=filtered)
    with _DOOR.reading(path) as reading:
        model: Model = _module(form).read(reading)
        expect_drawable(path, model)
        return model


def write(form: Format, new: Path, model: Model) -> None:
    """Write a model into a file that does not exist yet.

    Args:
        form: the format.
        new: the file, in a folder that ``atomic.staging`` or ``atomic.replacing`` gave.
        model: the Gaussians, and their thresholds if they have any.

    Raises:
        OutputError: the format cannot hold the model or its thresholds.
    """
    from fragprune_plugins.files.ply import write_ply

    if model.pruned:
        expect_carrier(form, new)
    if form.paired:
        write_ply(new, model)
        return
    if model.filter_3d is not None:
        raise OutputError(
            new.name,
            f"a {form.name} file, which cannot hold Mip-Splatting's 3D filter",
            "a PLY",
            "Fuse the filter first (create_fused_ply.py in Mip-Splatting).",
        )
    with open(new, "wb") as file:
        try:
            _module(form).write(file, model.to("cpu"))
        except ValueError as error:
            found = f"a {form.name} file, which cannot hold {error}"
            raise OutputError(
                new.name, found, "another format", "Choose another suffix."
            ) from error


def expect_carrier(form: Format, path: Path) -> None:
    """Raise OutputError if files of a format cannot hold thresholds and a stop."""
    if not form.carries:
        raise OutputError(
            str(path),
            f"a {form.name} file, which cannot hold thresholds: its picture would be worse and "
            "heavier than that of the pruned model",
            "a file that holds them: " + ", ".join(e.suffix for e in FORMATS if e.carries),
            "Choose another suffix. fragprune export --no-truncation writes the model without its "
            "thresholds; fragprune finetune --portable learns a model that needs none.",
        )


def _module(form: Format) -> Any:
    return importlib.import_module(f"fragprune_plugins.workbench.models.formats.{form.module}")
