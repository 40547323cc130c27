"""The attacks: each takes options and a scene on disk, and says what became of its inputs."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import os
import random
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from attack import hostile
from attack.running import Outcome, Result, command, in_child, judged, raised
from attack.surfaces import SURFACES
from finetune import tiny
from fuzz.readers import READERS
from fuzz.running import run as fuzz

import fragprune_plugins as fp
from fragprune_plugins.engines import create_engine
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.inputs import native_arrays, native_inputs
from fragprune_plugins.errors import SidecarError
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import write_ply
from fragprune_plugins.injection.starting import _read_checkpoint
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins.hooks import engine_for, schedule_for, thresholds_for
from fragprune_plugins.plugins.hookspecs import hookimpl
from fragprune_plugins.plugins.loading import Plugins
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.models import model as models


@dataclass(frozen=True)
class Options:
    """What the command line says.

    Attributes:
        folder: scratch.
        inputs: mutated inputs of each reader, and other random ones.
        seed: of all that is random.
    """

    folder: Path
    inputs: int
    seed: int


@dataclass(frozen=True)
class Scene:
    """A small scene: COLMAP data, a model of 40 Gaussians, and its cameras."""

    folder: Path

    @property
    def data(self) -> Path:
        return self.folder / "data"

    @property
    def model(self) -> Path:
        return self.folder / "model.ply"

    @property
    def out(self) -> Path:
        return self.folder / "out"


def scene(folder: Path) -> Scene:
    """Make the scene."""
    truth = tiny.random_model(40)
    made = Scene(folder)
    folder.mkdir(parents=True)
    tiny.write_colmap(made.data, tiny.photographs(truth), binary=True)
    write_ply(made.model, truth)
    return made


@contextlib.contextmanager
def fresh(options: Options) -> Iterator[Scene]:
    """A copy of the scene for one input."""
    kept, used = options.folder / "kept", options.folder / "used"
    if not kept.exists():
        scene(kept)
    shutil.copytree(kept, used)
    try:
        yield Scene(used)
    finally:
        shutil.rmtree(used, ignore_errors=True)


def warm(options: Options) -> None:
    """Run commands once on what is good, so that their children need not import everything."""
    with fresh(options) as at:
        more = ("report", at.out, "--data", at.data), ("check", at.folder)
        for words in (*commands(at).values(), *more):
            kind, said = command(*words)
            if kind not in ("fine", "stated"):
                raise RuntimeError(f"{words[0]} of a good scene: {kind}, {said}")


def commands(at: Scene, *names: str) -> dict[str, tuple[object, ...]]:
    """Words of commands that read the model and the data, by the command's name."""
    words = {
        "render": ("--data", at.data, "--out", at.out, "--views", "all"),
        "profile": ("--data", at.data),
        "compare": (at.model, "--data", at.data),
        "finetune": ("--data", at.data, "--out", at.out / "o.ply", "--iters", 1),
        "export": ("--out", at.out / "e.ply"),
    }
    engine = ("--threads", 1, "--engine", "cpu")
    drawn = {name: engine for name in words if name != "export"}
    return {n: (n, at.model, *words[n], *drawn.get(n, ())) for n in names or words}


def _each(
    options: Options,
    cases: dict[str, Any],
    put: Callable[[Scene, Any], None],
    words: Callable[[Scene], dict[str, tuple[object, ...]]],
) -> Result:
    """Put every case into a scene of its own, and run commands on it."""
    result = Result()
    for name, content in cases.items():
        with fresh(options) as at:
            put(at, content)
            for which, given in words(at).items():
                outcome = in_child(lambda given=given: command(*given))
                result.note(f"{which}: {name}", judged(name, outcome))
    return result


def hostile_ply(options: Options) -> Result:
    def put(at: Scene, content: bytes) -> None:
        at.model.write_bytes(content)

    return _each(options, hostile.plies(options.folder), put, lambda at: commands(at, "render"))


def hostile_sidecars(options: Options) -> Result:
    def put(at: Scene, content: bytes) -> None:
        sidecar.path_beside(at.model).write_bytes(content)

    with fresh(options) as at:
        cases = hostile.sidecars(at.model)
    names = ("render", "finetune", "profile", "export")

    def words(at: Scene) -> dict[str, tuple[object, ...]]:
        return commands(at, *names)

    return _each(options, cases, put, words)


def hostile_colmap(options: Options) -> Result:
    def put(at: Scene, files: dict[str, bytes]) -> None:
        sparse = at.data / "sparse" / "0"
        if any(name.endswith(".txt") for name in files):
            shutil.rmtree(at.data)
            tiny.write_colmap(at.data, [torch.zeros(3, 32, 32)] * 9)
        for name, content in files.items():
            binary = name == "images.bin"
            (sparse / name).write_bytes(hostile.among(content) if binary else content)

    cases = hostile.COLMAP | hostile.COLMAP_TEXT
    return _each(options, cases, put, lambda at: commands(at, "render"))


def hostile_images(options: Options) -> Result:
    def put(at: Scene, content: bytes) -> None:
        (at.data / "images" / "view01.png").write_bytes(content)

    def words(at: Scene) -> dict[str, tuple[object, ...]]:
        return {"profile": (*commands(at, "profile")["profile"], "--views", "all")}

    return _each(options, hostile.images(), put, words)


def hostile_cameras(options: Options) -> Result:
    def put(at: Scene, content: bytes) -> None:
        (at.folder / "cameras.json").write_bytes(content)

    def words(at: Scene) -> dict[str, tuple[object, ...]]:
        cameras = at.folder / "cameras.json"
        return {"render": ("render", at.model, "--cameras", cameras, "--out", at.out)}

    return _each(options, hostile.cameras(), put, words)


def hostile_records(options: Options) -> Result:
    return _with_records(options, lambda at: {"report": ("report", at.out, "--threads", 1)})


def hostile_comparisons(options: Options) -> Result:
    """Records again: compare takes the photographs and the way of drawing out of them."""

    def words(at: Scene) -> dict[str, tuple[object, ...]]:
        return {"compare": ("compare", at.model, at.out / "o.ply", "--threads", 1)}

    used = (*hostile.TEXTS, "as it is", "data", "command", "photographs", "resolution", "drawing")
    return _with_records(options, words, used)


def _with_records(
    options: Options,
    words: Callable[[Scene], dict[str, tuple[object, ...]]],
    used: tuple[str, ...] = ("",),
) -> Result:
    """Hostile records beside a fine-tuned model; only cases whose names begin as ``used`` says."""
    learned = options.folder / "learned"
    with fresh(options) as at:
        given = commands(at, "finetune")["finetune"]
        kind, said = in_child(lambda: command(*given))
        if kind != "fine":
            raise RuntimeError(f"the fine-tuning of a good model: {kind}, {said}")
        good = json.loads((at.out / "o.fragprune.json").read_text())
        shutil.copytree(at.out, learned)

    def put(at: Scene, content: bytes) -> None:
        shutil.copytree(learned, at.out)
        (at.out / "o.fragprune.json").write_bytes(content)

    cases = hostile.records(good).items()
    chosen = {name: c for name, c in cases if name.removeprefix(hostile.GOOD).startswith(used)}
    return _each(options, chosen, put, words)


def hostile_sources(options: Options) -> Result:
    def put(at: Scene, files: dict[str, bytes]) -> None:
        for name, content in files.items():
            path = at.folder / "host" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def words(at: Scene) -> dict[str, tuple[object, ...]]:
        host = at.folder / "host"
        return {"check": ("check", host), "verbose": ("check", host, "--verbose")}

    return _each(options, hostile.sources(), put, words)


def no_files(options: Options) -> Result:
    """Pipes, devices, folders and loops in place of every file that a command reads."""
    places: dict[str, Callable[[Scene], tuple[Path, str]]] = {
        "model": lambda at: (at.model, "render"),
        "sidecar": lambda at: (sidecar.path_beside(at.model), "render"),
        "cameras.bin": lambda at: (at.data / "sparse" / "0" / "cameras.bin", "render"),
        "images.bin": lambda at: (at.data / "sparse" / "0" / "images.bin", "render"),
        "image": lambda at: (at.data / "images" / "view01.png", "finetune"),
    }
    result = Result()
    for place, where in places.items():
        for kind in hostile.SPECIAL:
            with fresh(options) as at:
                path, which = where(at)
                path.unlink(missing_ok=True)
                hostile.special(path, kind)
                given = commands(at, which)[which]
                outcome = in_child(lambda given=given: command(*given))
                # A link to nowhere in place of a sidecar is no sidecar.
                name = hostile.GOOD if (place, kind) in _NONE else ""
                result.note(f"{place} is a {kind}", judged(name, outcome))
    return result


_NONE = {("sidecar", "dangling"), ("sidecar", "loop")}


def names(options: Options) -> Result:
    """Names that are too long, control a terminal, or climb out of a folder."""
    result = Result()
    for name in ("x" * 300, "a\nb\x1b[2J", "\udcff", "..", "\u202e", " "):
        with fresh(options) as at:
            for given in (
                ("render", at.folder / name, "--data", at.data, "--out", at.out),
                ("profile", at.model, "--data", at.folder / name),
                ("render", at.model, "--cameras", at.folder / name, "--out", at.out),
                ("check", at.folder / "nothing" / name),
                ("report", at.folder / "nothing" / name),
            ):
                outcome = in_child(lambda given=given: command(*given))
                result.note(f"{given[0]} {name!r}", judged("", outcome))
            entry = hostile.camera_entry() | {"img_name": name}
            (at.folder / "c.json").write_text(json.dumps([entry, entry]))
            given = ("render", at.model, "--cameras", at.folder / "c.json", "--out", at.out)
            outcome = in_child(lambda given=given: _inside(given, at))
            result.note(f"a view named {name!r}", judged(hostile.GOOD, outcome))
    with fresh(options) as at:
        long = at.model.rename(at.model.with_name("m" * 240 + ".ply"))
        for given in (
            ("render", long, "--data", at.data, "--out", at.out),
            ("profile", long, "--data", at.data, "--out", at.folder / ("x" * 300)),
            ("finetune", long, "--data", at.data, "--iters", 1, "--out", at.out / long.name),
        ):
            outcome = in_child(lambda given=given: command(*given))
            result.note(f"{given[0]} with names of 240 letters", outcome)
    return result


def _inside(given: tuple[object, ...], at: Scene) -> Outcome:
    """Run a command that draws two views of one name: two pictures, in the folder."""
    before = set(at.folder.rglob("*"))
    outcome = command(*given)
    made = set(at.folder.rglob("*")) - before - {at.out}
    if outcome[0] == "fine" and (len(made) != 2 or any(p.parent != at.out for p in made)):
        return "nonsense", f"made {sorted(map(str, made))}"
    return outcome


def mutated(options: Options) -> Result:
    """Every reader on broken files, in a child of bounded memory."""
    result = Result()
    kinds = {"read": "fine", "foreign": "traceback", "slow": "hang", "memory": "crash"}
    for reader in READERS:
        tally = fuzz(reader, options.inputs, seed=options.seed)
        for kind, count in tally.outcomes.items():
            result.outcomes[kinds.get(kind, kind)] += count
        result.found += [f"{kind}: {reader.name}: {words}" for kind, words in tally.found]
    return result


class _Evil:
    """Runs a command when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.file}",)


def checkpoints(options: Options) -> Result:
    result, executed = Result(), options.folder / "executed"
    path = options.folder / "chkpnt7.pth"
    deep: list[Any] = []
    for _ in range(400):
        deep = [deep]
    contents = {
        "runs a command": (_Evil(executed), 7),
        "runs a command inside": (({"a": [_Evil(executed)]},), 7),
        "a class of ours": (Settings(), 7),
        "an iteration that is none": ((), "seven"),
        "three values": ((), 7, 8),
        "no tuple": 5,
        "nested 400 deep": (deep, "x"),
    }
    for name, value in contents.items():
        torch.save(value, path)
        result.note(name, judged(name, in_child(lambda: raised(lambda: _read_checkpoint(path)))))
    torch.save(((torch.zeros(9),), 7), path)
    good = path.read_bytes()
    for name, content in {
        hostile.GOOD + "as it is": good,
        "nothing": b"",
        "half": good[: len(good) // 2],
        "a text": b"no checkpoint",
        "an old pickle": b"\x80\x02cos\nsystem\nq\x00X\x04\x00\x00\x00true\x85R.",
        "an empty zip": b"PK\x05\x06" + bytes(18),
    }.items():
        path.write_bytes(content)
        result.note(name, judged(name, in_child(lambda: raised(lambda: _read_checkpoint(path)))))
    if executed.exists():
        result.note("any", ("nonsense", "a checkpoint ran a command"))
    return result


def engine_from_python(options: Options) -> Result:
    """Tensors of wrong lengths, kinds and values: stated, or a finite picture."""
    dice = random.Random(options.seed)
    good = _inputs()
    engine = create_engine("cpu")

    def once() -> Outcome:
        def act() -> None:
            changed = {name: _wrong(dice, getattr(good.splats, name)) for name in _some(dice)}
            splats = replace(good.splats, **changed)
            usual = good.view.width
            size = dice.choice((*[usual] * 6, 0, -1, 1 << 20, 33))
            view = replace(good.view, width=size, tan_fov_x=dice.choice(_VALUES))
            thresholds = torch.rand(len(good.splats))
            thresholds = dice.choice((None, thresholds, _wrong(dice, thresholds)))
            out = fp.rasterize(RasterInputs(view, splats), thresholds, engine=engine)
            assert bool(out.image.isfinite().all()), "a picture that is not finite"

        return raised(act)

    def batch() -> Outcome:
        counts = Result()
        for number in range(options.inputs):
            counts.note(str(number), once())
        return "fine", json.dumps([counts.outcomes, counts.found[:5]])

    return _batched(batch)


def _batched(batch: Callable[[], Outcome]) -> Result:
    """The result of many inputs in one child."""
    result = Result()
    kind, words = in_child(batch, patience=600)
    if kind != "fine":
        result.note("all", (kind, words))
        return result
    outcomes, found = json.loads(words)
    result.outcomes.update(outcomes)
    result.found += found
    return result


_VALUES = (0.4, 0.4, 0.4, 0.0, -1.0, float("nan"), float("inf"), 1e30)


def _inputs() -> RasterInputs:
    return RasterInputs(tiny.cameras(1)[0].view(), tiny.random_model(40).splats())


def _some(dice: random.Random) -> list[str]:
    kinds = ["means", "opacities", "scales", "rotations", "sh"]
    return dice.sample(kinds, dice.choice((0, 1, 1, 2)))


def _wrong(dice: random.Random, tensor: torch.Tensor) -> Any:
    """A tensor in another state."""
    value = dice.choice(_VALUES)
    rows = tensor.detach().clone()
    rows[dice.randrange(len(rows))] = value
    return dice.choice(
        [
            rows,
            rows,
            rows,
            tensor[1:],
            tensor[:0],
            torch.cat([tensor, tensor]),
            tensor.T.contiguous() if tensor.ndim == 2 else tensor[:, None],
            tensor.T if tensor.ndim == 2 else tensor.flip(0),
            tensor.to(dice.choice([torch.float64, torch.int32, torch.bool, torch.complex64])),
            tensor.to("meta"),
            tensor.to_sparse(),
            tensor.numpy(),
            None,
            value,
        ]
    )


def native_interface(options: Options) -> Result:
    """The C interface through ctypes: counts and options at odds with the stated lengths."""
    dice = random.Random(options.seed)
    library, inputs = binding.library(), _inputs()
    arrays = native_arrays(inputs, torch.rand(40))
    wild = (0, 1, -1, 2, 39, 41, 1 << 16, (1 << 31) - 1, 1 << 31, 1 << 40, 1 << 62)
    whole = ("count", "width", "height", "threads", "sh_degree", "sh_coefficients")
    whole += ("feature_count", "compensation", "size", "widen", "cap_gradient")
    real = ("tan_fov_x", "tan_fov_y", "scale_modifier", "dilation", "near", "alpha_max", "stop")

    def batch() -> Outcome:
        counts = Result()
        for number in range(options.inputs):
            given = native_inputs(inputs, arrays, widen=False)
            for name in dice.sample(whole, dice.choice((0, 1, 1, 2))):
                value = dice.choice(wild)
                kind = dict(given._fields_)[name]
                setattr(given, name, kind(value).value)
            for name in dice.sample(real, dice.choice((0, 1, 2))):
                setattr(given, name, dice.choice(_VALUES))
            for name in dice.sample(sorted(arrays), dice.choice((0, 0, 1, 2))):
                what = dice.randrange(3)
                if what != 1:
                    setattr(given, name, None)
                if what != 2:  # the length says less than there is, or that there is nothing
                    setattr(given.lengths, name, 0 if what == 0 else dice.choice(wild[:5]))
            counts.note(str(number), _drawn(library, given))
        return "fine", json.dumps([counts.outcomes, counts.found[:5]])

    return _batched(batch)


def _drawn(library: Any, given: Any) -> Outcome:
    """Draw into buffers of the size that is asked for, unless no call may ask for it."""
    side = 1 << 10
    pixels = given.width * given.height if 0 < given.width <= side >= given.height > 0 else 1 << 20
    image = torch.zeros(3 * max(pixels, 1))
    radii = torch.zeros(max(1, min(given.count, 1 << 20)), dtype=torch.int32)
    outputs = binding.Outputs(image=image.data_ptr(), radii=radii.data_ptr())
    if given.width * given.height > 1 << 20:  # else it would draw beyond the buffer, as it was told
        given.width = given.height = 1 << 17
    error = binding.Error()
    status = library.calls.fragprune_forward(
        ctypes.byref(given), ctypes.byref(outputs), None, ctypes.byref(error)
    )
    if status == binding.OK:
        finite = bool(image.isfinite().all())
        return ("fine", "") if finite else ("nonsense", "a picture that is not finite")
    said = error.message.decode(errors="replace")
    return ("stated", said) if said else ("nonsense", f"status {status} without a word")


def threads_and_forks(options: Options) -> Result:
    """Eight threads on one engine, and forks while it draws: the same bits."""
    del options
    result, inputs = Result(), _inputs()
    engine, thresholds = create_engine("cpu"), torch.rand(40)
    wanted = engine.rasterize(inputs, thresholds).image
    wrong: list[str] = []

    def draw() -> None:
        for _ in range(20):
            if not torch.equal(engine.rasterize(inputs, thresholds).image, wanted):
                wrong.append("other bits")

    def together() -> Outcome:
        crew = [threading.Thread(target=draw) for _ in range(8)]
        for each in crew:
            each.start()
        for each in crew:
            each.join()
        return ("nonsense", wrong[0]) if wrong else ("fine", "")

    def same() -> Outcome:
        equal = torch.equal(engine.rasterize(inputs, thresholds).image, wanted)
        return ("fine", "") if equal else ("nonsense", "other bits after a fork")

    result.note("8 threads, 160 frames", in_child(together))
    worker = threading.Thread(target=lambda: [draw() for _ in range(20)])
    worker.start()
    for number in range(20):
        result.note(f"fork {number} while a thread draws", in_child(same, patience=30))
    worker.join()
    return result


def leaks(options: Options) -> Result:
    """Frames forward and backward, files read and refused: memory stays as it was."""
    bad = options.folder / "bad.ply"
    bad.write_bytes(hostile.header("element vertex 99", "property float x"))

    def batch() -> Outcome:
        engine, inputs = create_engine("cpu"), _inputs()
        opacities = inputs.splats.opacities.clone().requires_grad_()
        splats = replace(inputs.splats, opacities=opacities)
        seen = []
        for number in range(1200):
            engine.rasterize(RasterInputs(inputs.view, splats), None).image.sum().backward()
            raised(lambda: models.load(bad))
            if number % 100 == 99:
                gc.collect()
                seen.append(_resident())
        grown = seen[-1] - seen[3]
        kind = "fine" if grown < 4 << 20 else "nonsense"
        return kind, json.dumps(
            [{kind: 1200}, [f"{kind}: grew by {grown} bytes"] * (kind != "fine")]
        )

    kind, words = in_child(batch, patience=300)
    result = Result()
    if kind not in ("fine", "nonsense"):
        result.note("all", (kind, words))
        return result
    outcomes, found = json.loads(words)
    result.outcomes.update(outcomes)
    result.found += found
    return result


def _resident() -> int:
    fields = Path("/proc/self/statm").read_text().split()
    return int(fields[1]) * os.sysconf("SC_PAGE_SIZE")


def kills_while_saving(options: Options) -> Result:
    """SIGKILL while a pair is saved over a pair: one of the two is there, whole."""
    dice, result = random.Random(options.seed), Result()
    path = options.folder / "pair" / "m.ply"
    pairs = [_pair(number) for number in (1, 2)]
    models.save(path, pairs[0])
    known = [pair.thresholds.values.tolist() for pair in pairs]
    for number in range(max(20, options.inputs // 10)):
        child = os.fork()
        if child == 0:
            while True:
                for pair in pairs:
                    models.save(path, pair)
        time.sleep(dice.uniform(0.005, 0.05))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        try:
            store = models.load(path).thresholds
            whole = store is not None and store.values.tolist() in known
            outcome = ("fine", "") if whole else ("nonsense", "neither pair")
        except SidecarError as error:
            outcome = "nonsense", f"a broken pair: {error.found}"
            models.save(path, pairs[0])
        result.note(f"kill {number}", outcome)
    return result


def _pair(seed: int) -> models.Model:
    store = ThresholdStore(40)
    store.open(torch.full((40,), 0.2 + 0.2 * seed))
    return models.Model(tiny.random_model(40, seed=seed), store)


def plugins(options: Options) -> Result:
    """Plugins that raise, exit, or answer nonsense: the error names them."""
    del options
    result, inputs, store = Result(), _inputs(), ThresholdStore(40)
    store.open(torch.full((40,), 0.5))

    def exits() -> None:
        raise SystemExit(7)

    def divides() -> float:
        return 1 / 0

    answers: dict[str, Callable[[], Any]] = {
        "raises": divides,
        "exits": exits,
        "recurses": lambda: _recursing(),
        "answers a word": lambda: "nonsense",
        "answers a number": lambda: 5,
        "answers an empty object": object,
        "answers NaN": lambda: torch.full((40,), float("nan")),
        "answers too few": lambda: torch.rand(3),
        "answers integers": lambda: torch.ones(40, dtype=torch.int64),
    }
    asked: dict[str, Callable[[Plugins], Any]] = {
        "fragprune_truncate": lambda p: thresholds_for(inputs, store, p),
        "fragprune_create_engine": lambda p: engine_for("auto", "cpu", p),
        "fragprune_create_schedule": lambda p: schedule_for(Settings(), p),
    }
    makers: dict[str, Callable[[Callable[[], Any]], Any]] = {
        "fragprune_truncate": lambda act: lambda inputs, store: act(),
        "fragprune_create_engine": lambda act: lambda name, device: act(),
        "fragprune_create_schedule": lambda act: lambda settings: act(),
    }
    for hook, ask in asked.items():
        for name, act in answers.items():
            registered = Plugins()
            plugin = SimpleNamespace(**{hook: hookimpl(makers[hook](act))})
            registered.register(plugin, "mine")
            outcome = in_child(lambda ask=ask, p=registered: raised(lambda: ask(p)))
            if outcome[0] == "stated" and "plugin mine" not in outcome[1]:
                outcome = "nonsense", f"the plugin is not named: {outcome[1]}"
            result.note(f"{hook} {name}", judged("", outcome))
    for name, adapter in {"a word": "not an adapter", "None": None, "a class": int}.items():

        def offering(register: Callable[[Any], None], adapter: Any = adapter) -> None:
            register(adapter)

        plugin = SimpleNamespace(fragprune_register_adapters=hookimpl(offering))
        outcome = in_child(lambda p=plugin: raised(lambda: Plugins().register(p, "mine")))
        result.note(f"registers {name}", judged("", outcome))
    return result


def _recursing() -> Any:
    return _recursing()


def network(options: Options) -> Result:
    """The main commands with sockets that refuse to be made."""
    result = Result()

    def closed(*words: object) -> Outcome:
        tried = []

        def refuse(*_: Any, **__: Any) -> None:
            tried.append("")
            raise OSError("no network")

        for name in ("socket", "create_connection", "getaddrinfo"):
            setattr(socket, name, refuse)
        outcome = command(*words)
        return ("nonsense", f"{len(tried)} attempts") if tried else outcome

    with fresh(options) as at:
        for name, words in (
            *commands(at).items(),
            ("report", ("report", at.out, "--data", at.data)),
            ("check", ("check", at.folder)),
            ("adapters", ("adapters",)),
            ("doctor", ("doctor",)),
        ):
            outcome = in_child(lambda words=words: closed(*words), patience=120)
            result.note(name, outcome)
    return result


ATTACKS: dict[str, Callable[[Options], Result]] = {
    "hostile PLY through render": hostile_ply,
    "hostile sidecars through render, finetune, profile, export": hostile_sidecars,
    "hostile COLMAP models through render": hostile_colmap,
    "hostile photographs through profile": hostile_images,
    "hostile transforms and cameras.json through render": hostile_cameras,
    "hostile records through report": hostile_records,
    "hostile records through compare": hostile_comparisons,
    "hostile sources through check": hostile_sources,
    "pipes, devices, folders and loops in place of files": no_files,
    "names that are too long, climb, or control a terminal": names,
    "mutated files, every reader": mutated,
    "malicious and broken checkpoints": checkpoints,
    "the engine from Python, wrong tensors": engine_from_python,
    "the C interface, wrong counts and lengths": native_interface,
    "8 threads on one engine, forks while it draws": threads_and_forks,
    "leak: frames and refused files": leaks,
    "SIGKILL while a pair is saved over a pair": kills_while_saving,
    "plugins that raise, exit or answer nonsense": plugins,
    "commands without a network": network,
    **{name: partial(act, fresh=fresh, words=commands) for name, act in SURFACES.items()},
}
