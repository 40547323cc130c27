"""Trains and measures the arms of an experiment; what is done already is not done again."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

import fragprune_plugins
from fragprune_plugins.bench.machine import describe_machine
from fragprune_plugins.datasets.dataset import Dataset, load_photographs
from fragprune_plugins.datasets.photographs import Photographs
from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import Interrupted, RecordError, Terminated
from fragprune_plugins.experiments.catalogue import Arm, Experiment
from fragprune_plugins.finetuning import FinetuneResult, finetune
from fragprune_plugins.measure import Candidate, frame_times, measure
from fragprune_plugins.storage import models
from fragprune_plugins.storage.atomic import digest, replacing, writable_folder
from fragprune_plugins.storage.ply import SplatFile
from fragprune_plugins.storage.records import strict

ENLARGED = 4
"""Frames are timed at the photographs' size, and with sides this many times as long."""

RESULTS = (".md", ".csv", ".png")
"""Endings of the files that results are written to, after the experiment's name."""

_SAID = 5  # differences that a refusal lists


@dataclass(frozen=True)
class Outcome:
    """One arm, trained with one seed and measured.

    Attributes:
        arm: what was trained.
        seed: of the order of views.
        before: measurement of the model as it came, without thresholds (``measure``), and
            "frame_ms_enlarged" with "frame_ms_enlarged_se"; timed in turns with ``after``.
        after: of the model as trained, with its thresholds.
        train_seconds: wall-clock seconds of the training.
    """

    arm: Arm
    seed: int
    before: dict[str, Any]
    after: dict[str, Any]
    train_seconds: float


def run(
    experiment: Experiment,
    model: Path,
    photographs: Photographs,
    out: Path,
    *,
    engine: Engine,
    device: torch.device | str = "cpu",
    seeds: Sequence[int] = (0,),
    progress: bool = False,
) -> tuple[dict[str, Any], list[Outcome]]:
    """Train and measure what is missing of an experiment.

    Writes OUT/NAME.json, the configuration, and a file for each arm and seed into OUT/arms as soon
    as it is measured, so that an interrupted experiment goes on where it was.

    Args:
        experiment: what to compare.
        model: the trained splat; thresholds stored beside it are ignored.
        photographs: to learn from, and to measure on.
        out: the folder.
        engine: draws everything.
        device: of the model and views.
        seeds: one training of every arm for each.
        progress: draw bars on stderr.

    Returns:
        The configuration, and the outcomes in the order of arms and seeds.

    Raises:
        RecordError: the folder holds this experiment in another configuration, or a file of it
            cannot be read.
        Interrupted: Ctrl-C; the arms that were finished stay.
        Terminated: SIGTERM; likewise.
    """
    from tqdm import tqdm

    splat, _ = models.load(model, truncation=False, device=device)
    dataset = load_photographs(photographs).to(device)
    asked = _configuration(experiment, model, photographs, dataset, engine, device, seeds)
    writable_folder(out / "arms")
    _settle(out / f"{experiment.name}.json", asked)
    mark = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()
    jobs = list(_jobs(experiment, seeds, out))
    outcomes = []
    with tqdm(jobs, disable=not progress, desc=experiment.name, unit="training") as bar:
        for arm, seed, path in bar:
            bar.set_postfix_str(f"{arm.label}, seed {seed}")
            if not path.exists():
                result = _train(arm, seed, splat, dataset, engine, progress)
                before, after = _measure(splat, result, dataset, engine)
                done = {"before": before, "after": after, "train_seconds": result.train_seconds}
                _write(path, {"configuration": mark, "arm": arm.label, "seed": seed} | done)
            outcomes.append(_read(path, mark, arm, seed))
    return asked, outcomes


def _jobs(
    experiment: Experiment, seeds: Sequence[int], out: Path
) -> Iterator[tuple[Arm, int, Path]]:
    """Every training and the file of its result."""
    for index, arm in enumerate(experiment.arms):
        slug = re.sub(r"[^a-z0-9.]+", "-", arm.label.lower())
        for seed in seeds:
            yield arm, seed, out / "arms" / f"{experiment.name}-{index:02d}-{slug}-seed{seed}.json"


def _train(
    arm: Arm, seed: int, splat: SplatFile, dataset: Dataset, engine: Engine, progress: bool
) -> FinetuneResult:
    settings = replace(arm.settings, seed=seed)
    result = finetune(splat, dataset, settings, rule=arm.rule, engine=engine, progress=progress)
    if result.interrupted:
        raise (Terminated if result.terminated else Interrupted)(
            arm.label,
            f"stopped after {result.progress.steps} of {settings.iterations} iterations",
            "all of them",
            "Repeat the command: finished arms are kept.",
        )
    return result


def _measure(
    splat: SplatFile, result: FinetuneResult, dataset: Dataset, engine: Engine
) -> list[dict[str, Any]]:
    """Measurements before and after, timed in turns at both sizes."""
    candidates = [Candidate(splat), Candidate(result.model, result.store)]
    views = [
        replace(s.view, width=ENLARGED * s.view.width, height=ENLARGED * s.view.height)
        for s in dataset.test
    ]
    measured = measure(candidates, dataset.test, engine=engine)
    enlarged = frame_times(candidates, views, engine)
    return [
        usual | {f"{key}_enlarged": value for key, value in large.items()}
        for usual, large in zip(measured, enlarged, strict=True)
    ]


def _configuration(
    experiment: Experiment,
    model: Path,
    photographs: Photographs,
    dataset: Dataset,
    engine: Engine,
    device: torch.device | str,
    seeds: Sequence[int],
) -> dict[str, Any]:
    """Everything that decides about the figures, as plain values."""
    asked = {
        "experiment": experiment.name,
        "asks": experiment.asks,
        "arms": {
            arm.label: {
                "settings": {k: v for k, v in arm.settings.as_dict().items() if k != "seed"},
                "rule": arm.rule and arm.rule.name,
            }
            for arm in experiment.arms
        },
        "seeds": list(seeds),
        "version": fragprune_plugins.__version__,
        "model": {"name": model.name, "sha256": digest(model)},
        "photographs": photographs.as_dict()
        | {
            "folder": photographs.folder.resolve().name,
            "sha256": _digest(dataset),
            "training_views": len(dataset.train),
            "held_out_views": len(dataset.test),
        },
        "engine": engine.name,
        "device": str(device),
        "threads": torch.get_num_threads(),
        "machine": describe_machine(device),
    }
    plain: dict[str, Any] = json.loads(json.dumps(asked))
    return plain


def _digest(dataset: Dataset) -> str:
    """The SHA-256 digest of the photographs and their cameras."""
    sha = hashlib.sha256()
    for shot in (*dataset.train, *dataset.test):
        sha.update(shot.name.encode())
        sha.update((255 * shot.image).round().byte().cpu().numpy().tobytes())
        sha.update(shot.view.projmatrix.cpu().numpy().tobytes())
    return sha.hexdigest()


def _settle(path: Path, asked: dict[str, Any]) -> None:
    """Write the configuration; if one is there already, it has to be the same.

    A table or plot without a configuration is somebody else's, and stays.
    """
    if not path.exists():
        taken = [path.with_suffix(end) for end in RESULTS if path.with_suffix(end).exists()]
        if taken:
            raise RecordError(
                str(taken[0]),
                "a file that no experiment wrote",
                f"a folder without {', '.join(each.name for each in taken)}",
                "Choose another --out.",
            )
        _write(path, asked)
        return
    was = _load(path)
    differ = _differences(was, asked)
    if differ or list(was["arms"]) != list(asked["arms"]):
        more = f"; and {len(differ) - _SAID} more" if len(differ) > _SAID else ""
        raise RecordError(
            str(path),
            "; ".join(differ[:_SAID]) + more or "the same arms in another order",
            "the configuration that the folder was begun with",
            "Choose another --out, or repeat the command as it was.",
        )


def _differences(was: Any, now: Any, name: str = "") -> list[str]:
    """What differs between plain values, in words; keys of nested dicts are joined with dots."""
    if not (isinstance(was, dict) and isinstance(now, dict)):
        return [] if was == now else [f"{name} was {was} and is {now}"]
    said = []
    for key in dict.fromkeys((*was, *now)):
        inner = f"{name}.{key}" if name else key
        if key in was and key in now:
            said += _differences(was[key], now[key], inner)
        else:
            said.append(f"{inner} is {'missing' if key in was else 'new'}")
    return said


def _read(path: Path, mark: str, arm: Arm, seed: int) -> Outcome:
    content = _load(path)
    if content.get("configuration") != mark:
        raise RecordError(
            str(path),
            "a result of another configuration",
            "one of the configuration that is asked for",
            "Choose another --out, or remove the file.",
        )
    return Outcome(arm, seed, content["before"], content["after"], content["train_seconds"])


def _load(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise ValueError("not an object")
        return content
    except (OSError, ValueError) as error:
        raise RecordError(
            str(path), f"unreadable ({error})", "a file that an experiment wrote", "Remove it."
        ) from error


def _write(path: Path, content: dict[str, Any]) -> None:
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(strict(content), indent=1) + "\n", encoding="utf-8")
