"""What a training left beside its model tells of photographs: held out, elsewhere, or exposed."""

from __future__ import annotations

import contextlib
from collections import Counter
from pathlib import Path

import torch

from fragprune_plugins.errors import DatasetError, log, printable
from fragprune_plugins.files.reading import UntrustedFile
from fragprune_plugins.types import View
from fragprune_plugins.workbench.scenes.cameras import load_cameras
from fragprune_plugins.workbench.scenes.dataset import Dataset
from fragprune_plugins.workbench.scenes.output import arguments, cameras_of, output_folder
from fragprune_plugins.workbench.scenes.transforms import matrix

_FAR = 0.01  # of the cameras' extent, or radians: other worlds are further, files round less
_NEUTRAL = 1e-3  # of exposures: a change that no 8-bit level shows

_EXPOSURES = UntrustedFile(
    DatasetError,
    "not readable as exposures",
    "the exposure.json that a host wrote",
    "Remove it if its exposures are neutral.",
)


def saw_held_out(model: Path, dataset: Dataset) -> bool:
    """Whether the training of a model saw views that are held out here, as far as it can be known.

    They are training photographs too, or it held none out by its arguments; or its cameras.json, in
    which hosts list first what they hold out, says so, which is warned of.
    """
    told = arguments(model)
    if dataset.leaked or (told and not told.held_out):
        return True
    listed = [name for name, _ in _listed(model)]
    train, held = (Counter(_base(s.name) for s in each) for each in (dataset.train, dataset.test))
    first, others = Counter(listed[: held.total()]), Counter(listed[held.total() :])
    if not listed or (first == held and not (others - train) & held):
        return False
    log.warning(
        "%s: the training held out other views, of %d in all. Here %d of %d are held out: it may "
        "have seen them, so figures on them flatter it",
        *(printable(str(cameras_of(model))), len(listed)),
        *(held.total(), held.total() + train.total()),
    )
    return True


def moved(model: Path, dataset: Dataset) -> str:
    """The name of a photograph whose camera was elsewhere in a model's training; "" if none."""
    listed, extent = _listed(model), dataset.extent
    known = {} if len(dict(listed)) < len(listed) else dict(listed)  # as in Blender's layout
    for shot in (*dataset.train, *dataset.test):
        if was := known.get(_base(shot.name)):
            turned = (was.viewmatrix - shot.view.viewmatrix.cpu())[:3, :3].norm()
            far = (was.campos - shot.view.campos.cpu()).norm()
            if turned > _FAR or far > _FAR * extent:
                return shot.name
    return ""


def exposed(model: Path) -> str:
    """The name of a photograph that a training learned an exposure for; "" if there is none.

    What it drew had to be like the photograph only under that exposure. Hosts keep them as
    ``exposure.json``: the rows of a (3, 4) matrix by name, the identity if they learned none.
    """
    folder = output_folder(model)
    path = folder / "exposure.json" if folder else None
    if path and path.is_file():
        with _EXPOSURES.reading(path) as reading:
            for name, rows in reading.json().items():
                reading.place = name
                if (matrix(rows, (3, 4)) - torch.eye(3, 4)).abs().max() > _NEUTRAL:
                    return str(name)
    return ""


def exposures_left_out(*models: Path) -> list[str]:
    """A warning for figures of photographs, if a model was trained with exposures."""
    names = {str(model): name for model in models if (name := exposed(model))}
    return [
        f"{model} was trained with an exposure for each photograph ({name}, for one), and is "
        "measured without them: its PSNR is lower than its training's."
        for model, name in names.items()
    ]


def _listed(model: Path) -> list[tuple[str, View]]:
    """The cameras of a training by the names of their photographs, in its order."""
    path = cameras_of(model)
    with contextlib.suppress(DatasetError):
        cameras = load_cameras(path) if path else []
        return [(_base(name), view) for name, view in cameras]
    return []


def _base(name: str) -> str:
    """The name of a view as every host has it: without folders, up to its first dot."""
    return name.rpartition("/")[2].partition(".")[0]
