"""What the ``cameras.json`` of a model's training tells of photographs: held out, or elsewhere."""

from __future__ import annotations

import contextlib
from itertools import islice
from pathlib import Path

from fragprune_plugins.errors import DatasetError
from fragprune_plugins.types import View
from fragprune_plugins.workbench.scenes.cameras import load_cameras
from fragprune_plugins.workbench.scenes.dataset import Dataset
from fragprune_plugins.workbench.scenes.output import cameras_of, saw_all

_FAR = 0.01
"""Of the cameras' extent, or of a turn in radians: other worlds are further, files round less."""


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


def _listed(model: Path) -> dict[str, View]:
    """The cameras of a training by the stems of their photographs, in its order.

    None where two have one stem, as training and held-out views of Blender's layout.
    """
    path, cameras = cameras_of(model), list[tuple[str, View]]()
    with contextlib.suppress(DatasetError):
        cameras = load_cameras(path) if path else []
    stems = {Path(name).stem: view for name, view in cameras}
    return stems if len(stems) == len(cameras) else {}
