"""Measures two models on the same pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fragprune_plugins.errors import UsageError, log, printable
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.types import View
from fragprune_plugins.workbench.commands import command, opening, options
from fragprune_plugins.workbench.figures import evaluate, matching, records, wording
from fragprune_plugins.workbench.figures.pictures import leave_panels
from fragprune_plugins.workbench.models.model import load, writable_folder
from fragprune_plugins.workbench.scenes import output, training


def compare(
    *,
    a: Path,
    b: Path,
    itself: bool,
    orbit: bool,
    cameras: Path | None,
    scene: options.SceneOptions,
    out: Path | None,
    views: str,
    no_truncation: bool,
    enlarge: int,
    engine: options.EngineOptions,
) -> command.Report:
    """Do what ``fragprune compare`` promises; its options are the arguments."""
    rasterizer, device = opening.open_engine(engine)
    if out is not None:
        writable_folder(out)
    known = _records(a, b)
    own = opening.own_cameras_for(a, scene, cameras, orbit=orbit) if itself else None
    if own is None and scene.data is None:  # of the fine-tuning with --self that wrote one of them
        written = filter(None, map(records.beside, (a, b)))
        own = next(filter(None, (opening.own_cameras(each, scene) for each in written)), None)
    photographs = None if own else _photographs(scene, known, a, b)
    candidates = []
    for path in (a, b):
        how = known.get(path)
        filtered, drawing = (how.filtered, how.drawing) if how else opening.as_trained(path)
        model = load(path, truncation=not no_truncation, filtered=filtered, device=device)
        candidates.append(evaluate.Candidate(model, {} if own else drawing))
    if own is not None:
        dataset, shown = own.pictures(candidates[0].model, rasterizer), "A's own"
    else:
        assert photographs is not None
        photographs, dataset = matching.told_or_matched(
            candidates[0].model, photographs, rasterizer
        )
        shown = f"{photographs.folder}"
    shots = opening.chosen(dataset, views)
    before, after = evaluate.measure_all(candidates, shots, engine=rasterizer, enlarge=enlarge)
    drawn = [each["fragments_per_pixel"] for each in (before, after)]
    report = {
        "a": {"model": str(a)} | before,
        "b": {"model": str(b)} | after,
        "target": after["target"],
        "speedup": drawn[0] / drawn[1] if drawn[1] else None,
        "psnr_change": after["psnr"] - before["psnr"],
        "ssim_change": after["ssim"] - before["ssim"],
        "engine": after["engine"],
        "device": before["device"],
        "enlarge": enlarge,
        "scene": photographs and records.plain(photographs),
        "warnings": [
            *wording.nothing_drawn(drawn),
            *matching.hardly_shown({"A": before["psnr"], "B": after["psnr"]}, shots),
            *(training.exposures_left_out(a, b) if photographs else []),
        ],
    }
    lines = _lines(report, shown, [shot.view for shot in shots])
    if out is not None:
        columns = dict(zip("AB", candidates, strict=True))
        lines.append(leave_panels(out, "compare", report, columns, shots, rasterizer))
    return command.Report(report, "\n".join(lines))


def _lines(report: dict[str, Any], shown: str, views: Sequence[View]) -> list[str]:
    """What a person reads."""
    a, b, enlarge = report["a"], report["b"], report["enlarge"]
    size = wording.sizes([(view.width, view.height) for view in views])
    large = wording.sizes([(enlarge * view.width, enlarge * view.height) for view in views])
    pictures = "Photographs" if report["scene"] else "Pictures"
    return [
        f"A: {a['model']}\nB: {b['model']}\n{pictures}: {shown}, {size} pixels\n",
        wording.describe({"A": a, "B": b}),
        *([f"Frames of {large} pixels."] if enlarge > 1 else []),
        f"\nB against A: {wording.gain(a, b, enlarge)}.",
        *(f"Warning: {each}" for each in report["warnings"]),
    ]


def _records(*models: Path) -> dict[Path, records.Recorded]:
    """By model, what its record says; that of one holds also for a host's own model without any."""
    found = {model: record for model in models if (record := records.beside(model))}
    every = {model: records.recorded(record) for model, record in found.items()}
    known = {model: read for model, read in every.items() if read}
    if len(known) == 1:
        (read,) = known.values()
        for model in set(models) - known.keys():
            began = model.resolve() == read.models[0]
            if began or (output.output_folder(model) and not opening.as_trained(model)[0]):
                known[model] = read
            if read.drawing and known.get(model) and not began:
                said = "%s has no record of how it was drawn, and is drawn as the other model was"
                log.warning(said, printable(str(model)))
    return known


def _photographs(
    scene: options.SceneOptions, known: dict[Path, records.Recorded], *models: Path
) -> Photographs:
    """The photographs that the options name; else those of the records or of the trainings."""
    read = {each.photographs for each in known.values()}
    if not read and scene.data is None:
        read = {each for each in map(output.trained_on, models) if each is not None}
    if len(read) == 1:
        return opening.overridden(read.pop(), scene)
    if scene.data is None:
        found = "no folder, and no record of a run or cfg_args of a training beside the models"
        if read:
            found = "no folder, and the models' runs read photographs in two ways"
        remedy = "Name it with --data; without photographs, pass --self."
        raise UsageError("--data", found, "a scene folder, or A's own pictures", remedy)
    return opening.drawn_as_trained(scene, *models)
