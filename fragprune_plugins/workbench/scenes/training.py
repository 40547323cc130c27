"""What a training left beside its model tells of photographs: held out, elsewhere, or exposed."""

from __future__ import annotations

import contextlib
from itertools import islice
from pathlib import Path

import torch

from fragprune_plugins.errors import DatasetError
from fragprune_plugins.files.reading import UntrustedFile
from fragprune_plugins.types import View
from fragprune_plugins.workbench.scenes.cameras import load_cameras
from fragprune_plugins.workbench.scenes.dataset import Dataset
from fragprune_plugins.workbench.scenes.output import cameras_of, output_folder, saw_all
from fragprune_plugins.workbench.scenes.transforms import matrix

_FAR = 0.01
"""Of the cameras' extent, or of a turn in radians: other worlds are further, files round less."""
_NEUTRAL = 1e-3
"""Of exposures: a change that no 8-bit level shows."""

_EXPOSURES = UntrustedFile(
    DatasetError,
    "not readable as exposures",
    "the exposure.json that a host wrote",
    "Remove it if its exposures are neutral.",
)


def saw_held_out(model: Path, dataset: Dataset) -> bool:
    """Whether the training of a model is known to have seen some of the held-out photographs.

    Hosts list the views that they hold out first in ``cameras.json``.
    """
    listed, held = _listed(model), {Path(shot.name).stem for shot in dataset.test}
    others = listed.keys() >= held and {*islice(listed, len(held))} != held
    return dataset.leaked > 0 or saw_all(model) or others


def moved(model: Path, dataset: Dataset) -> str:
    """The name of a photograph whose camera was elsewhere in the training of a model; "" if none.

    Its codebase may turn or scale the world, or move cameras, after it reads them.
    """
    listed, extent = _listed(model), dataset.extent
    for shot in (*dataset.train, *dataset.test):
        was = listed.get(Path(shot.name).stem)
        if was is not None:
            turned = (was.viewmatrix - shot.view.viewmatrix.cpu())[:3, :3].norm()
            far = (was.campos - shot.view.campos.cpu()).norm()
            if turned > _FAR or far > _FAR * extent:
                return shot.name
    return ""


def exposed(model: Path) -> str:
    """The name of a photograph that a training learned an exposure for; "" if there is none.

    What it drew had to be like the photograph only under that exposure. Hosts keep them as
    ``exposure.json``: the rows of a (3, 4) matrix by name, the identity if they learned none.

    Raises:
        DatasetError: the file cannot be read.
    """
    folder = output_folder(model)
    path = folder / "exposure.json" if folder else None
    if path is None or not path.is_file():
        return ""
    with _EXPOSURES.reading(path) as reading:
        for name, rows in reading.json().items():
            reading.place = name
            if (matrix(rows, (3, 4)) - torch.eye(3, 4)).abs().max() > _NEUTRAL:
                return str(name)
    return ""


def _listed(model: Path) -> dict[str, View]:
    """The cameras of a training by the stems of their photographs, in its order.

    None where two have one stem, as training and held-out views of Blender's layout.
    """
    path, cameras = cameras_of(model), list[tuple[str, View]]()
    with contextlib.suppress(DatasetError):
        cameras = load_cameras(path) if path else []
    stems = {Path(name).stem: view for name, view in cameras}
    return stems if len(stems) == len(cameras) else {}
