"""Every reader as a function of bytes: what it gives is looked at, what it raises is judged."""

import io
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import click
import torch
from campaigns.fuzz import seeds
from finetune import tiny
from miniatures.vanilla_3dgs import HOST

from fragprune_plugins.adapting import HostRepo, RasterInputs, UsageError, View
from fragprune_plugins.engines import create_engine
from fragprune_plugins.files import sidecar
from fragprune_plugins.hosts.adapter import ConfigFile, read_config
from fragprune_plugins.hosts.preflight import missing_imports
from fragprune_plugins.injection.starting import resumed_at
from fragprune_plugins.workbench import finetune
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.figures.records import recorded
from fragprune_plugins.workbench.finetune import resuming
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.report import work as report
from fragprune_plugins.workbench.scenes import colmap
from fragprune_plugins.workbench.scenes.cameras import load_cameras
from fragprune_plugins.workbench.scenes.dataset import Photograph
from fragprune_plugins.workbench.scenes.normalised import worlds
from fragprune_plugins.workbench.scenes.output import trained_on
from fragprune_vanilla_3dgs import Vanilla3DGS


class Nonsense(Exception):  # noqa: N818 - what was found
    """A reader gave what nobody can use, and said nothing."""


def _sound(name: str, holds: bool) -> None:
    if not holds:
        raise Nonsense(name)


@cache
def _engine() -> object:
    return create_engine("cpu")


def _view() -> View:
    return tiny.cameras(1)[0].view()


def _ply(file: Path) -> None:
    model = models.load(file)
    with torch.no_grad():
        inputs = RasterInputs(_view(), model.splats(), planes=())
        drawn = _engine().rasterize(inputs, model.falloff)
    _sound("a picture that is not finite", bool(drawn.image.isfinite().all()))


def _format(suffix: str) -> Callable[[Path], None]:
    """A file of a model under its suffix."""

    def read(file: Path) -> None:
        _ply(file.rename(file.with_name(f"m{suffix}")))

    return read


def _sog_beside(file: Path) -> None:
    """``meta.json`` of a SOG; the images beside it are good."""
    with zipfile.ZipFile(io.BytesIO(seeds.good()["sog"]["degree1.sog"])) as archive:
        archive.extractall(file.parent)
    _ply(file.replace(file.with_name("meta.json")))


def _sidecar(file: Path) -> None:
    """The file lies beside a model that it may or may not belong to."""
    model = file.with_name("m.ply")
    model.write_bytes(_model())
    file.replace(sidecar.path_beside(model))
    store, _ = sidecar.load(model, seeds.GAUSSIANS)
    _sound("another number of thresholds", len(store) == seeds.GAUSSIANS)
    inside = (store.values > 0) & (store.values < 1)
    _sound("thresholds outside (0, 1)", bool(inside.all()))
    _sound("moments that are not finite", all(map(_finite, store.numbers.values())))


def _finite(numbers: torch.Tensor) -> bool:
    return bool(numbers.isfinite().all())


@cache
def _model() -> bytes:
    return seeds.model()


def _plausible(view: View) -> None:
    numbers = [view.viewmatrix, view.projmatrix, view.campos]
    _sound("a camera that is not finite", all(map(_finite, numbers)))
    turn = view.viewmatrix[:3, :3].double()
    _sound("a pose that is no rotation", _close(turn @ turn.T, torch.eye(3).double()))
    sides = 0 < view.tan_fov_x < 1e3 and 0 < view.tan_fov_y < 1e3
    _sound("a field of view that is none", sides and 0 < view.width * view.height <= 1 << 32)


def _close(one: torch.Tensor, other: torch.Tensor) -> bool:
    return float((one - other).abs().max()) < 0.02


def _colmap(name: str) -> Callable[[Path], None]:
    """One file of a COLMAP model; its partner is good."""
    kind = name.partition(".")[2]
    partner = f"images.{kind}" if name.startswith("cameras") else f"cameras.{kind}"

    def read(file: Path) -> None:
        sparse = file.parent / "sparse"
        sparse.mkdir(exist_ok=True)
        (sparse / partner).write_bytes(seeds.good()[partner][f"a.{kind}"])
        file.replace(sparse / name)
        for part in colmap.read(file.parent):
            for row in part:
                _plausible(row.camera.view())

    return read


def _points(name: str) -> Callable[[Path], None]:
    """The points of a COLMAP model, whose cameras have a place in the worlds that these give."""

    def read(file: Path) -> None:
        sparse = file.parent / "sparse"
        sparse.mkdir(exist_ok=True)
        for partner in ("cameras.bin", "images.bin"):
            (sparse / partner).write_bytes(seeds.good()[partner]["a.bin"])
        file.replace(sparse / name)
        for world in worlds(file.parent):
            for row in colmap.read(file.parent)[0]:
                _plausible(row.camera.moved(torch.tensor(world, dtype=torch.float64)).view())

    return read


def _views(file: Path) -> None:
    for _, view in load_cameras(file):
        _plausible(view)


def _record(file: Path) -> None:
    file.rename(file.with_name("a.fragprune.json"))
    for each in records.find(file.parent):
        report._told(each, [])
        recorded(each)
        records.control_of(each.data, [each.path])


def _image(file: Path) -> None:
    picture = Photograph("a", _view(), file).image
    _sound("a picture of another size", picture.shape == (3, tiny.SIDE, tiny.SIDE))


def _mask(file: Path) -> None:
    good = file.with_name("good.png")
    good.write_bytes(seeds.good()["image"]["a.png"])
    picture = Photograph("a", _view(), good, mask=file).image
    _sound("a picture of another size", picture.shape == (3, tiny.SIDE, tiny.SIDE))


def _settings(file: Path) -> None:
    model = file.with_name("m.ply")
    model.touch()
    words = [str(model), "--out", "o.ply", "--config", str(file)]
    try:
        finetune.command.make_context("finetune", words)
    except click.UsageError as error:  # the command prints it, and ends with 2
        found = error.format_message()
        raise UsageError("--config", found, "options", "Check the file.") from error


def _checkpoint(file: Path) -> None:
    resumed_at(Vanilla3DGS().command_line(HostRepo(HOST)), file)


def _progress(file: Path) -> None:
    tensors, values = resuming.read(file, "cpu")
    _sound("numbers that are not finite", all(map(_finite, tensors.values())))
    _sound("no values", isinstance(values, dict))


def _source(file: Path) -> None:
    """The bytes are two modules of a host: one that has seams, and its script."""
    (file.parent / "gaussian_renderer").mkdir(exist_ok=True)
    (file.parent / "gaussian_renderer" / "__init__.py").write_bytes(file.read_bytes())
    file.rename(file.with_name("train.py"))
    repo, adapter = HostRepo(file.parent), Vanilla3DGS()
    match = adapter.match(repo)
    failed = [each for each in match.findings if each.code == "adapter-failed"]
    _sound(f"an adapter that failed: {failed}", not failed)
    missing_imports(repo, [file.with_name("train.py")], ())


def _git(file: Path) -> None:
    (file.parent / "secret").write_text("f00d f00d f00d\n")
    folder = file.parent / ".git"
    (folder / "refs" / "heads").mkdir(parents=True, exist_ok=True)
    (folder / "refs" / "heads" / "main").write_text("0123456789abcdef0123456789abcdef01234567\n")
    file.rename(folder / "HEAD")
    commit = HostRepo(file.parent).commit
    _sound(f"a commit {commit[:90]!r}", commit == "" or set(commit) <= set("0123456789abcdef"))


def _config(file: Path) -> None:
    values = read_config(ConfigFile("--config"), file)
    _sound("no names", all(isinstance(name, str) for name in values))


def _arguments(file: Path) -> None:
    folder = file.parent / "point_cloud" / "iteration_7"
    folder.mkdir(parents=True, exist_ok=True)
    file.rename(file.with_name("cfg_args"))
    trained_on(folder / "point_cloud.ply")


@dataclass(frozen=True)
class Reader:
    """Its name is also that of its seeds; it raises Nonsense for what nobody can use."""

    name: str
    read: Callable[[Path], None]

    def pool(self) -> list[bytes]:
        return [*seeds.good()[self.name].values(), *self.found().values()]

    def found(self) -> dict[str, bytes]:
        """By name what broke it once."""
        files = sorted((seeds.CORPUS / self.name).glob("found-*"))
        return {path.name: path.read_bytes() for path in files}


READERS = [
    Reader("ply", _ply),
    *(Reader(name, _format(f".{name}")) for name in ("compressed.ply", "spz", "sog", "glb")),
    Reader("splat", _format(".splat")),
    Reader("sog.json", _sog_beside),
    Reader("sidecar", _sidecar),
    *(Reader(name, _colmap(name)) for name in ("cameras.bin", "images.bin")),
    *(Reader(name, _colmap(name)) for name in ("cameras.txt", "images.txt")),
    *(Reader(name, _points(name)) for name in ("points3D.bin", "points3D.txt")),
    Reader("transforms", _views),
    Reader("cameras.json", _views),
    Reader("record", _record),
    Reader("image", _image),
    Reader("mask", _mask),
    Reader("settings", _settings),
    Reader("checkpoint", _checkpoint),
    Reader("progress", _progress),
    Reader("source", _source),
    Reader("git", _git),
    Reader("config", _config),
    Reader("cfg_args", _arguments),
]
BY_NAME = {reader.name: reader for reader in READERS}
