"""The file formats of models, from which every command reads and writes.

A file is read by the suffix of its name; a name without a suffix of a format counts as a PLY. PLY
is what hosts write. Every other format is an entry point, ours too: its name is the suffix without
the first dot, and its object a ``Format``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from fragprune_plugins.errors import ModelFileError, OutputError, PluginError
from fragprune_plugins.files.reading import Reading, UntrustedFile
from fragprune_plugins.plugins.points import CODE, blaming, load, offered

if TYPE_CHECKING:
    from fragprune_plugins.files.model import Model

GROUP = "fragprune.formats"  # the entry-point group of formats


@dataclass(frozen=True)
class Format:
    """A file format of models.

    ``write`` gets a model on the CPU; its ValueError says what the format cannot hold. Of a model
    files hold ``thresholds``, such as "to 8 bits", and keep what ``keeps`` says; "" means none, and
    every bit.
    """

    name: str
    suffix: str  # the end of a file's name
    read: Callable[[Reading], Model]
    write: Callable[[BinaryIO, Model], None]
    thresholds: str = ""
    keeps: str = ""
    claims: Callable[[Path], bool] = lambda path: False  # whether a PLY is of this format

    @property
    def paired(self) -> bool:
        """Whether a sidecar may hold the thresholds of this format's files."""
        return self is PLY


def _of_its_own(*_: object) -> Model:
    raise NotImplementedError("read_ply and write_ply take paths")


PLY = Format("PLY", ".ply", _of_its_own, _of_its_own, thresholds="as a column")  # type: ignore[arg-type]

SUFFIXES = (".ply", *(f".{name}" for name in offered(GROUP)))
"""The end of the name of every file that is read and written."""

ENDINGS = tuple(dict.fromkeys(Path(f"model{each}").suffix for each in SUFFIXES))
"""The last suffixes of such names; that of a compressed PLY is .ply."""

_FILE = UntrustedFile(
    ModelFileError,
    "not readable",
    "a complete trained splat",
    "The file is of another kind or was cut off: copy or save it again.",
    missing="Pass a trained splat: " + ", ".join(SUFFIXES) + ".",
)


@cache
def of_suffix(suffix: str) -> Format:
    """The format with one of ``SUFFIXES``; PluginError if its package cannot be loaded."""
    if suffix == PLY.suffix:
        return PLY
    point = offered(GROUP)[suffix.removeprefix(".")]
    form: Format = load(point, Format)
    # Of what else ``read`` raises a file may be the cause; of ours always. It is stated there.
    ours = point.value.startswith("fragprune_plugins.")
    read = form.read if ours else blaming(point, faults=CODE)(form.read)
    write = blaming(point, ValueError, OSError, MemoryError)(form.write)
    return replace(form, read=read, write=write, claims=blaming(point)(form.claims))


def named(path: Path) -> Format:
    """The format that a file to write gets by its name; OutputError if none has this suffix."""
    fitting = [suffix for suffix in SUFFIXES if path.name.lower().endswith(suffix)]
    if not fitting:
        expected = "a name in " + ", ".join(SUFFIXES)
        raise OutputError(str(path), "not the name of a model", expected, "Rename it.")
    return of_suffix(max(fitting, key=len))


def found(path: Path) -> Format:
    """The format of a file to read: by its name, and for a PLY by its header."""
    if path.name == "meta.json":  # of a SOG that is not bundled
        return of_suffix(".sog")
    for suffix in SUFFIXES:
        if path.name.lower().endswith(suffix) and not suffix.endswith(".ply"):
            return of_suffix(suffix)
    headed = (of_suffix(suffix) for suffix in SUFFIXES if suffix.endswith(".ply"))
    return next((form for form in headed if form.claims(path)), PLY)


def read(path: Path, *, filtered: bool = False) -> Model:
    """Read a model of any format, with the thresholds of the file; ``filtered`` as in ``read_ply``.

    A file that is missing, truncated, of another kind, empty or not finite: ModelFileError.
    """
    from fragprune_plugins.files.ply import expect_drawable, read_ply

    form = found(path)
    if form.paired:
        return read_ply(path, filtered=filtered)
    with _FILE.reading(path) as reading:
        model = form.read(reading)
        if not hasattr(model, "xyz"):
            kind, remedy = type(model).__name__, "Update or uninstall its package."
            raise PluginError(f"format {form.name}", f"{kind} from {path}", "a Model", remedy)
        expect_drawable(path, model)
        return model


def write(form: Format, new: Path, model: Model) -> None:
    """Write a model into a file that does not exist yet, in a folder that ``atomic.staging`` gave.

    A format that cannot hold the model or its thresholds raises OutputError.
    """
    from fragprune_plugins.workbench.models.formats.ply import write_ply

    if model.pruned:
        expect_carrier(form, new)
    if form.paired:
        write_ply(new, model)
        return
    if model.filter_3d is not None:
        found = f"a {form.name} file, which cannot hold Mip-Splatting's 3D filter"
        remedy = "Fuse the filter first (create_fused_ply.py in Mip-Splatting)."
        raise OutputError(new.name, found, "a PLY", remedy)
    with open(new, "wb") as file:
        try:
            form.write(file, model.to("cpu"))
        except ValueError as error:
            found = f"a {form.name} file, which cannot hold {error}"
            remedy = "Choose another suffix."
            raise OutputError(new.name, found, "another format", remedy) from error


def expect_carrier(form: Format, path: Path) -> None:
    """Raise OutputError if files of a format cannot hold thresholds and a stop."""
    if form.thresholds:
        return
    carriers = []
    for suffix in SUFFIXES:
        with contextlib.suppress(PluginError):
            carriers += [suffix] if of_suffix(suffix).thresholds else []
    raise OutputError(
        str(path),
        f"a {form.name} file, which cannot hold cutoffs: its picture would be worse and heavier "
        "than that of the pruned model",
        "a file that holds them: " + ", ".join(carriers),
        "Choose another suffix. fragprune export --no-truncation writes the model without its "
        "cutoffs; fragprune finetune --portable learns a model that needs none.",
    )
