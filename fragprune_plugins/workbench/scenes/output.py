"""The output folder of a training: which model to take, and which photographs it was made from.

The hosts write ``point_cloud/iteration_N/point_cloud.ply``, ``cameras.json``, and the command's
arguments as ``cfg_args``: the text of an ``argparse.Namespace``. Nothing of it is executed.
"""

from __future__ import annotations

import ast
import contextlib
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from fragprune_plugins.errors import DatasetError, ModelFileError, log, printable
from fragprune_plugins.files.reading import MEBIBYTE, UntrustedFile
from fragprune_plugins.hosts.photographs import Photographs, Resolution
from fragprune_plugins.hosts.source import parsed

ARGUMENTS, CAMERAS = "cfg_args", "cameras.json"
_DIVISORS = (1, 2, 4, 8)  # of -r; other numbers are widths
_LATE = "train_test_exp"  # of 3DGS since October 2024, which drops Blender's alpha, too
_READ = ("source_path", "images", "resolution", "white_background", "eval", _LATE)

_FILE = UntrustedFile(
    DatasetError,
    "not the arguments of a training",
    "Namespace(source_path=..., ...), as a 3DGS host writes it",
    "Name the photographs with --data.",
    limit=MEBIBYTE,
)


def newest_model(folder: Path) -> Path:
    """The PLY of the highest iteration in an output folder, or in the only one of a folder's."""
    outputs = {each.parent for each in folder.glob("*/point_cloud")}
    one = len(outputs) == 1 and not (folder / "point_cloud").exists()
    plys = (outputs.pop() if one else folder).glob("point_cloud/iteration_*/point_cloud.ply")
    numbers = ((re.fullmatch(r"iteration_(\d{1,9})", ply.parent.name), ply) for ply in plys)
    found = [(int(number[1]), ply) for number, ply in numbers if number]
    if not found:
        missing = "a folder without point_cloud/iteration_*/point_cloud.ply"
        expected = "a model, or the output folder of a training"
        raise ModelFileError(str(folder), missing, expected, "Pass the model's file.")
    return max(found)[1]


def output_folder(model: Path) -> Path | None:
    """The output folder that a host, or gsplat, wrote a model into; None if it lies elsewhere."""
    place, hosts = model.resolve(), {"point_cloud/iteration_*/*": 2, "ply/point_cloud_*.ply": 1}
    return next((place.parents[up] for file, up in hosts.items() if place.match(file)), None)


def cameras_of(model: Path) -> Path | None:
    """The cameras that a host wrote beside a model, if its output folder has them."""
    folder = output_folder(model)
    return folder / CAMERAS if folder is not None and (folder / CAMERAS).is_file() else None


def trained_on(model: Path) -> Photographs | None:
    """The photographs of a model's training, by the arguments in its output folder; else None.

    Without ``--eval`` it held no view out, which is warned of. Broken ones are a DatasetError.
    """
    if (known := _arguments(model)) is None:
        return None
    if not known.held_out:
        why = "it has seen the held-out views, so figures on them flatter it"
        folder = printable(str(output_folder(model)))
        log.warning("%s was trained without --eval: %s", folder, why)
    return replace(known, held_out=True)


def read_otherwise(model: Path, now: Photographs) -> list[str]:
    """Arguments by which the training of a model read its photographs otherwise."""
    then = arguments(model) or now
    names = ("images", "resolution", "white_background")
    other = [name for name in names if getattr(then, name) != getattr(now, name)]
    return other + ["eval"] * (then.held_out and not now.held_out)


def arguments(model: Path) -> Photographs | None:
    """The photographs of a model's training, and whether it held views out; None if not known."""
    with contextlib.suppress(DatasetError):
        return _arguments(model)
    return None


def _arguments(model: Path) -> Photographs | None:
    """The same; DatasetError where they cannot be read."""
    folder = output_folder(model)
    if folder is None or not (folder / ARGUMENTS).exists():
        return None
    with _FILE.reading(folder / ARGUMENTS) as reading:
        tree = parsed(reading.text().strip())
        match tree.body if tree else []:
            case [ast.Expr(value=ast.Call(func=ast.Name(id="Namespace"), keywords=words))]:
                pass
            case _:
                raise ValueError("no Namespace(...)")
        values: dict[str, Any] = {}
        for word in words:
            if word.arg in _READ:
                reading.place = word.arg
                values[word.arg] = ast.literal_eval(word.value)
        reading.place = ""
        return replace(told_by(values), held_out=bool(values.get("eval", False)))


def told_by(values: Mapping[str, Any]) -> Photographs:
    """The photographs that the arguments of a 3DGS host name, by their names there.

    A host without an argument for their size reads them as they are.
    """
    source, size = Path(str(values["source_path"])), values.get("resolution")
    return Photographs(
        source,
        Resolution() if size is None else Resolution.asked(int(size), _DIVISORS),
        bool(values.get("white_background", False)),
        str(values.get("images", "images")),
        centred=True,
        opaque=_LATE in values or not (source / "transforms_train.json").exists(),
    )
