"""Opens what options name: an engine, photographs, cameras."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import torch

from fragprune_plugins.engines import Engine, device_for
from fragprune_plugins.errors import DatasetError, RecordError, UsageError, log, printable
from fragprune_plugins.files.model import Model
from fragprune_plugins.hosts.photographs import Photographs, Resolution
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.workbench.commands.options import EngineOptions, SceneOptions
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.ranks import launched, local_rank
from fragprune_plugins.workbench.scenes import generated, output
from fragprune_plugins.workbench.scenes.cameras import load_cameras, load_scene_cameras, sized
from fragprune_plugins.workbench.scenes.dataset import Dataset, Shot


def bound_threads(threads: int | None) -> None:
    """Limit torch and the engines to this many CPU threads; None sets no limit."""
    if threads is not None:
        torch.set_num_threads(threads)


def open_engine(options: EngineOptions) -> tuple[Engine, torch.device]:
    """The engine of the options, its threads bounded, and the device for models and views."""
    bound_threads(options.threads)
    device = device_for(options.device, options.name)
    if launched().several and options.device in ("auto", "cuda") and device.type == "cuda":
        device = device_for(f"cuda:{local_rank()}", options.name)
    return engine_for(options.name, device), device


def photographs_for(
    model: Path, scene: SceneOptions, *, remedy: str = "Name the scene's folder with --data."
) -> Photographs:
    """The photographs that the options name; without --data those that the model was trained on.

    Options that were given override what the training says. Without either it is a UsageError,
    and what cannot be read of its arguments or its record is a DatasetError or a RecordError.
    """
    if scene.data is not None:
        return drawn_as_trained(scene, model)
    trained = output.trained_on(model) or _recorded(model)
    if trained is None:
        found = f"no folder, and no record beside {model} or {output.ARGUMENTS} of a training"
        raise UsageError("--data", found, "photographs", remedy)
    said = f"Photographs: {trained.folder}, which the model was trained on"
    click.echo(printable(said), err=True)
    return overridden(trained, scene)


def drawn_as_trained(scene: SceneOptions, *models: Path) -> Photographs:
    """The photographs in --data, over the background and around the point of models' trainings."""
    known = [Photographs(Path())]
    for told in (output.trained_on, _recorded):  # the latter tells better
        for model in models:
            with contextlib.suppress(DatasetError, RecordError):
                known.append(told(model) or known[-1])
    return overridden(replace(known[-1], images="images", resolution=Resolution()), scene)


def _recorded(model: Path) -> Photographs | None:
    """The photographs in a model's record; of its own pictures, those of the model before."""
    if (record := records.beside(model)) is None:
        known = _of_run(model)
        return known.photographs if known else None
    if read := records.recorded(record):
        return read.photographs
    return output.trained_on(records.located(str(record.data.get("model")), record.path.parent))


def as_trained(model: Path) -> tuple[bool, Mapping[str, Any]]:
    """The ``filtered`` and the ``drawing`` of a model, by the record of the run that trained it."""
    return (known.filtered, known.drawing) if (known := _of_run(model)) else (False, {})


def _of_run(model: Path) -> records.Recorded | None:
    """What the record of the run that trained a model says; None if no folder of its has one."""
    written, folder = model.stat().st_mtime_ns, output.output_folder(model)
    with contextlib.suppress(RecordError):
        found = records.find(folder) if folder else [records.beside(model)]
        for record in filter(None, reversed(found)):
            read, path = records.recorded(record), record.path
            own = read and model.resolve() in [each.resolve() for each in read.models]
            current = path.parent.samefile(model.parent) or path.stat().st_mtime_ns >= written
            if read and own and current:  # else it is of another training
                return read
    return None


def warn_if_antialiased(*models: Path) -> None:
    """Warn of models that their runs drew with antialiasing, in a command that draws without."""
    said = "%s was trained with antialiasing, and is drawn here as 3DGS draws, without"
    for model in models:
        if as_trained(model)[1].get("compensation", "none") != "none":
            log.warning(said, printable(str(model)))


def overridden(photographs: Photographs, scene: SceneOptions) -> Photographs:
    """Photographs of a record, with the options that the user gave in place of what it says."""
    given = {name: getattr(scene, name) for name in ("images", "resolution") if name in scene.given}
    white = scene.white_background or photographs.white_background
    folder = scene.data or photographs.folder
    return replace(photographs, folder=folder, white_background=white, **given)


def chosen(dataset: Dataset, views: str) -> Sequence[Shot]:
    """The views that ``--views`` names: "test", "train" or "all"."""
    named = {"test": dataset.test, "train": dataset.train, "all": [*dataset.train, *dataset.test]}
    return named[views]


@dataclass(frozen=True)
class OwnCameras:
    """The cameras of a model's own pictures: those that options name; all around it without any."""

    scene: SceneOptions
    cameras: Path | None
    seed: int = 0  # of what is generated

    def pictures(self, model: Model, engine: Engine) -> Dataset:
        """A model's own pictures from these cameras; DatasetError if these cannot be read."""
        scene, seed, held_out = self.scene, self.seed, None
        if scene.data is not None:
            views, test = load_scene_cameras(scene.data, white_background=scene.white_background)
            held_out = sized(test, scene.resolution)
        elif self.cameras is not None:
            views = load_cameras(self.cameras, white_background=scene.white_background)
        else:
            background = torch.full((3,), float(scene.white_background))
            views = generated.around(model, background=background, seed=seed)
        views = sized(views, scene.resolution)
        return generated.own_pictures(model, views, held_out, engine=engine, seed=seed)


def own_cameras_for(
    model: Path, scene: SceneOptions, cameras: Path | None, seed: int = 0, *, orbit: bool = False
) -> OwnCameras:
    """The cameras that the options name; without any those of the model's training, if it is known,
    at their size there. With ``orbit`` they are all around it. It is drawn over its background.
    """
    named = orbit or scene.data is not None or cameras is not None
    if not named and (cameras := output.cameras_of(model)):
        click.echo(printable(f"Cameras: {cameras}, of its training"), err=True)
        scene = at_its_size(model, scene)
    return OwnCameras(over_its_background(model, scene), cameras, seed)


def at_its_size(model: Path, scene: SceneOptions) -> SceneOptions:
    """The options, without ``--resolution`` at the size that a model's training had."""
    told = None if "resolution" in scene.given else output.arguments(model)
    return replace(scene, resolution=told.resolution) if told else scene


def over_its_background(model: Path, scene: SceneOptions) -> SceneOptions:
    """The options, over white also where a model's training or its record says that it was."""
    known: list[Any] = [scene, output.arguments(model)]
    with contextlib.suppress(RecordError):
        if record := records.beside(model):
            own, read = own_cameras(record), records.recorded(record)
            known += [own and own.scene, read and read.photographs]
    white = any(each.white_background for each in known if each)
    return replace(scene, white_background=white)


def own_cameras(record: records.Record, scene: SceneOptions | None = None) -> OwnCameras | None:
    """The cameras of a fine-tuning with --self, with options in their place; else None."""
    if (values := record.data.get("cameras")) is None:
        return None
    scene = scene or SceneOptions()
    with records.RECORD_FILE.stated(record.path) as reading:
        reading.place = "data.cameras"
        paths = (values.get(name) for name in ("data", "file"))
        data, cameras = (each and records.located(each, record.path.parent) for each in paths)
        size = Resolution(**values["resolution"])
        size = scene.resolution if "resolution" in scene.given else size
        white = scene.white_background or bool(values.get("white_background"))
        scene = replace(scene, data=data or None, resolution=size, white_background=white)
        return OwnCameras(scene, cameras or None, int(record.data["seed"]))
