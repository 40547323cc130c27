"""Makes the page of the results in a folder."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import DatasetError, ModelFileError, RecordError, SidecarError
from fragprune_plugins.files.model import Model
from fragprune_plugins.files.reading import MEBIBYTE, UntrustedFile, lies_in
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.commands.opening import OwnCameras, open_engine, own_cameras
from fragprune_plugins.workbench.commands.options import EngineOptions
from fragprune_plugins.workbench.figures import records, wording
from fragprune_plugins.workbench.figures.evaluate import Candidate
from fragprune_plugins.workbench.figures.page import Table, embedded
from fragprune_plugins.workbench.figures.records import CONTROL, RECORD_FILE, Record, recorded
from fragprune_plugins.workbench.goals import parse_goal
from fragprune_plugins.workbench.models.model import load
from fragprune_plugins.workbench.report import page as report_page
from fragprune_plugins.workbench.report.page import Drawn
from fragprune_plugins.workbench.scenes.dataset import Dataset, load_photographs

PAGE = "report.html"
_PNG = b"\x89PNG\r\n\x1a\n"
_PICTURE = UntrustedFile(RecordError, "no picture", "a PNG", "Remove it.", limit=64 * MEBIBYTE)
_LEARNED = ("run", "finetune")  # commands that learn
_HOW = "Name the scene with --data: then it is read, and so are the models of the record."

_ONLY_CONTROLS = (
    "This folder holds only controls, and no run or fine-tuning that truncates. "
    "Run the same command without --control, then report again."
)


def report(*, folder: Path, out: Path | None, data: Path | None, engine: EngineOptions) -> Report:
    """Do what ``fragprune report`` promises; its options are the arguments."""
    target = out or folder / PAGE
    with TemporaryDirectory() as name:
        pictures = Path(name)
        values, summary = results(folder, pictures, data, engine)
        how = report_page.TEMPLATE, lambda each: embedded(pictures / each)
        report_page.save(target, *how, values)
    lines = [summary["result"], *summary["notes"], f"Wrote {target}."]
    return Report({"page": str(target)} | summary, "\n".join(lines))


def results(
    folder: Path,
    pictures: Path,
    data: Path | None,
    engine: EngineOptions,
    *,
    enlarge: int = 1,
    first: str = "",
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a page says of the results in a folder, with its pictures in another.

    Args:
        data: the scene that the user named.
        enlarge: how many times as wide and high as the photographs models are drawn.
        first: the name of the view to begin with.

    Returns:
        Values for the page's template, and what ``--json`` says.
    """
    every = records.find(folder)
    files = [record.path for record in every]
    told = {record.path: _told(record, files) for record in every}
    results = [record for record in every if record.command in _LEARNED]
    pruned = [record for record in results if _goal(record) not in (None, CONTROL)]
    main = [*every, *results, *pruned][-1]
    control, of_main = _goal(main) == CONTROL, told.pop(main.path)
    drawn, learning, missing = _draw(main, folder, pictures, data, engine, enlarge, first)
    outdated = map(_outdated, every)
    notes = [*of_main["notes"], *outdated, _ONLY_CONTROLS if control else "", missing]
    notes = [note for note in notes if note]
    values = {
        **vars(drawn),
        **of_main,
        "title": f"{of_main['heading']} of {_of(main, folder)}",
        "seen": bool(main.data.get("seen")),
        "labels": ("original", "control") if control else report_page.NAMES,
        "notes": records.portable(notes, folder),
        "plots": [*learning, *_files(every, folder, pictures)],
        "others": [*told.values()],
    }
    summary = {
        "result": of_main["sentence"],
        "command": main.command,
        "control": control,
        "record": str(main.path),
        "views": [view.name for view in drawn.views],
        "pictures": len([*pictures.iterdir()]),
        **{key: main.data.get(key) for key in ("before", "after", "adapter", "iterations")},
        "notes": notes,
    }
    return values, summary


def _told(record: Record, among: Sequence[Path]) -> dict[str, Any]:
    """What the page says of a record; RecordError if it lacks some of it or has other types.

    ``among`` are the files that may record its control. Of a fine-tuning that was measured before
    and after, "facts" are its three figures, and "notes" lines on what came before it.
    """
    with RECORD_FILE.stated(record.path):
        data, columns = record.data, _columns(record)
        if (goal := _goal(record)) is not None:
            parse_goal(goal)
        for name in data.get("files", ()):
            Path(name)
        control, facts, notes = None, [], []
        if record.command in _LEARNED and len(columns) > 1:
            control = data.get("control") or records.control_of(data, among)
            facts, notes = wording.headlines(data, control), wording.begun(data)
            notes += [wording.bounded(data)] if data.get("max_drop") else []
        return {
            "heading": _heading(record),
            "sentence": _sentence(record, columns, control),
            "table": _table(record, columns),
            "facts": facts,
            "notes": notes,
            "settings": Table(["", ""], _settings(record), words=2),
        }


def _columns(record: Record) -> dict[str, dict[str, Any]]:
    """A record's measurements on held-out views, by name of the model."""
    data = record.data
    if record.command == "compare":
        return {"A": data["a"], "B": data["b"]}
    if record.command == "profile":
        return wording.profiled(data)
    return wording.columns_of(data)


def _table(record: Record, columns: dict[str, dict[str, Any]]) -> Table:
    """A table of the measurements, else of the figures on training views."""
    if columns:
        head, *rows = wording.tabulate(columns)
        return Table(head, rows, wording.measured_with(columns))
    seen = record.data["training_views"]
    drawn = [seen[f"fragments_per_pixel_{when}"] for when in ("before", "after")]
    cells = ["unknown" if each is None else f"{each:.2f}" for each in drawn]
    return Table(["on training views", "before", "after"], [["fragments per pixel", *cells]])


def _sentence(
    record: Record, columns: dict[str, dict[str, Any]], control: dict[str, Any] | None
) -> str:
    """The outcome as a sentence to quote."""
    data, measured = record.data, list(columns.values())
    name = data.get("adapter") or ""
    of = f"{name}, {data['iterations']:,} iterations: " if name else ""
    if len(measured) > 1 and record.command in _LEARNED:
        return of + wording.outcome(record.command, data, control)
    if record.command == "compare":
        of = f"A is {data['a']['model']}, B is {data['b']['model']}: "
    elif len(measured) > 1:  # of a profile
        without, drawn = columns
        of = f"{data['model']} {drawn}, against itself {without}: "
    if len(measured) > 1:
        return f"{of}{wording.gain(measured[0], measured[-1], data.get('enlarge', 1))}."
    if measured:
        drawn, frame = measured[0]["fragments_per_pixel"], measured[0]["frame_ms"]
        return f"{drawn:.1f} fragments per pixel drawn, frames of {frame:.2f} ms."
    seen = data["training_views"]
    if not (seen["fragments_per_pixel_before"] and seen["fragments_per_pixel_after"]):
        return f"{of}nothing was learned."
    return of + wording.outcome_in_training(data)


def _goal(record: Record) -> Any:
    """The goal of a fine-tuning, as text; None of another command."""
    return record.data.get("settings", {}).get("goal")


def _heading(record: Record) -> str:
    """What a record is about, in words."""
    if _goal(record) == CONTROL:
        return "The control: the same training without pruning"
    return {"compare": "Comparison", "profile": "Profile"}.get(record.command, "Pruning")


def _of(record: Record, folder: Path) -> str:
    """The name of what was pruned: a model's file, or the folder of a training."""
    name = Path(str(record.data.get("model", ""))).name if record.command == "finetune" else ""
    return name or folder.resolve().name


def _settings(record: Record) -> list[list[str]]:
    """The settings and files of a record, one a row."""
    keys = ("adapter", "engine", "device", "iterations", "gaussians", "train_seconds", "seed")
    facts = {key: record.data.get(key) for key in keys} | record.data.get("settings", {})
    facts |= {key: record.data.get(key) for key in ("model", "model_before", "model_after", "out")}
    known = {key.replace("_", " "): value for key, value in facts.items() if value is not None}
    return [[k, f"{v:.4g}" if isinstance(v, float) else str(v)] for k, v in known.items()]


@dataclass(frozen=True)
class _Source:
    """What the views of a record are drawn from."""

    models: Sequence[Path]  # original and pruned; joint learning leaves the latter alone
    filtered: bool
    drawing: Mapping[str, Any]
    needs: Sequence[Path]  # files and folders besides the models
    dataset: Callable[[Model, Engine], Dataset]


def _source(record: Record, data: Path | None) -> _Source | None:
    """The source of a record's views; ``data`` is the scene that the user named."""
    if own := own_cameras(record):
        with RECORD_FILE.stated(record.path):
            both = (record.data["model"], record.data["out"])
            models = [records.located(name, record.path.parent) for name in both]
        needs = list(filter(None, [own.scene.data, own.cameras]))
        pictures = own.pictures if needs else partial(_from_above, own)
        return _Source(models, False, {}, needs, pictures)
    if (read := recorded(record)) is None:
        return None
    scene = read.photographs if data is None else replace(read.photographs, folder=data)
    how = read.filtered, read.drawing, [scene.folder]
    return _Source(read.models, *how, lambda *_: load_photographs(scene))


def _from_above(own: OwnCameras, model: Model, engine: Engine) -> Dataset:
    """Pictures of a model from all around, shown from above: such cameras begin below it."""
    made = own.pictures(model, engine)
    return replace(made, test=made.test[len(made.test) // 2 :])


def _draw(
    record: Record,
    inside: Path,
    folder: Path,
    data: Path | None,
    options: EngineOptions,
    enlarge: int,
    first: str,
) -> tuple[Drawn, list[tuple[str, str]], str]:
    """Draw held-out views and learning curves into a folder; with an engine only if there are any.

    Files ``inside`` may be read without ``data``, which the user named. Returns the views,
    (heading, file) of further pictures, and why views are missing, or "".
    """
    source, curves = _source(record, data), record.data.get("curves")
    if source is None:
        return Drawn(), [], ""
    allowed = [each for each in source.models if data is not None or lies_in(each, inside)]
    learning: list[tuple[str, str]] = []
    try:
        engine, device = open_engine(options)
        loaded = [load(path, filtered=source.filtered, device=device) for path in allowed]
        if curves:
            values = loaded[-1].falloff if source.models[-1] in allowed else None
            with RECORD_FILE.stated(record.path) as reading:
                reading.place = "data.curves"
                report_page.save_learning(folder / report_page.LEARNING, curves, values)
            learning = [("How it learned", report_page.LEARNING)]
        if len(source.models) == 1:  # of joint learning, which leaves no model of before
            return Drawn(), learning, ""
        here = len(allowed) == 2 and all(lies_in(each, inside) for each in source.needs)
        if data is None and not here:
            missing = f"No views are shown: they need files outside of the folder. {_HOW}"
            return Drawn(), learning, missing
        dataset = source.dataset(loaded[0], engine)
    except (DatasetError, ModelFileError, SidecarError) as error:
        if data is not None:  # the user asked for the views
            raise
        return Drawn(), learning, f"No views are shown: {error}"
    if _outdated(record):
        return Drawn(), learning, f"No views are shown: {source.models[-1].name} was changed since."
    before, after = (Candidate(each, source.drawing) for each in loaded)
    shots = sorted(dataset.test, key=lambda shot: shot.name != first)
    return report_page.draw_views(folder, before, after, shots, engine, enlarge), learning, ""


def _outdated(record: Record) -> str:
    """A line for a result that was written over since its figures were taken; "" else."""
    name = Path(str(record.data.get("model_after") or record.data.get("out"))).name
    result = record.path.parent / name
    if record.sha256 and result.is_file() and not records.beside(result):
        return f"{name} was written again since: its figures are of the file before."
    return ""


def _files(every: list[Record], inside: Path, folder: Path) -> list[tuple[str, str]]:
    """Copy PNGs of compare and profile that lie ``inside``; returns (heading, file) of each."""
    found: list[tuple[str, str]] = []
    for record in every:
        for name in record.data.get("files", ()):
            file = record.path.parent / Path(name).name
            if not lies_in(file, inside):
                continue
            with contextlib.suppress(RecordError), _PICTURE.reading(file) as reading:
                content, copy = reading.file.read(), f"{len(found)}.png"
                if content.startswith(_PNG):
                    (folder / copy).write_bytes(content)
                    view = file.stem.removesuffix("_panel")
                    found.append((f"{_heading(record)}: {view}", copy))
    return found
