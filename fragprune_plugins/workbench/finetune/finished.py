"""What ``fragprune finetune`` reports: its data, its words, and the record beside its result."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import RecordError
from fragprune_plugins.files.model import Model
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.learning.interruption import EXIT_CODE
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.commands.options import EngineOptions, SceneOptions
from fragprune_plugins.workbench.figures import records, wording
from fragprune_plugins.workbench.figures.evaluate import Candidate, measure_all
from fragprune_plugins.workbench.finetune.loop import FinetuneResult
from fragprune_plugins.workbench.finetune.resuming import Checkpoints
from fragprune_plugins.workbench.finetune.searching import Bounded
from fragprune_plugins.workbench.finetune.trial import DROPOUT, KEEP
from fragprune_plugins.workbench.models import formats
from fragprune_plugins.workbench.models.model import describe_written, load
from fragprune_plugins.workbench.pruning import Keep
from fragprune_plugins.workbench.scenes.dataset import Dataset
from fragprune_plugins.workbench.scenes.output import output_folder

LOST = 0.05
"""A loss of PSNR against the model as it came, in dB, from which on more is advised."""

_OF_RECORDS = {"cameras", "curves", "photographs", "configuration", "text"}


@dataclass(frozen=True)
class Asked:
    """The options of the command, by their names there; more of a ``run`` that comes to this.

    Attributes:
        command: the one that the user gave.
        photographs: those to learn from; None for those of the options.
    """

    model: Path
    out: Path
    itself: bool
    scene: SceneOptions
    settings: Settings
    seed: int
    again: bool
    engine: EngineOptions
    cameras: Path | None = None
    keep: Keep | None = None
    shard: bool = False
    no_truncation: bool = False
    command: str = "finetune"
    photographs: Photographs | None = None


@dataclass(frozen=True)
class Opened:
    """What a fine-tuning works with.

    Attributes:
        asked: the command's options, later with what a trial chose.
        whole: the model, on ``device``; of all processes on the CPU, if they divide it.
        photographs: where they lie; None for the model's own pictures.
        configuration: what decides the result; a command of the same one is known again.
        seen: the training before saw views that are held out here.
    """

    asked: Asked
    whole: Model
    photographs: Photographs | None
    dataset: Dataset
    engine: Engine
    device: Any
    checkpoints: Checkpoints
    configuration: dict[str, Any]
    seen: bool


@dataclass(frozen=True, eq=False)
class Finetuned:
    """A fine-tuning that is over.

    Attributes:
        start: the model as it came in.
        forgotten: dB that a trial made other photographs worse; None without a trial.
        found: what a search for the strongest truncation found; None without one.
        truncated: the result has thresholds, here or in another process.
        shards: processes that hold a part of the Gaussians each; 1 where each holds them all.
    """

    opened: Opened
    start: Candidate
    result: FinetuneResult
    forgotten: float | None
    found: Bounded | None
    truncated: bool
    shards: int = 1

    @property
    def asked(self) -> Asked:
        """The command's options."""
        return self.opened.asked

    def measured(self, engine: Engine) -> dict[str, dict[str, Any]]:
        """Figures on held-out views: before, after; untruncated and control where there are any."""
        after = self.result.model
        if self._rounds and not self._as_learned:
            after = load(self.asked.out, device=after.device)
        whole = self.result.progress.gaussians
        models = {"before": self.start, "after": Candidate(after, gaussians=whole)}
        if self.truncated:
            models["untruncated"] = Candidate(after.untruncated(), gaussians=whole)
        if self.found is not None:
            models["control"] = Candidate(self.found.control.model)
        shots = self.opened.dataset.test
        figures = measure_all(list(models.values()), shots, engine=engine)
        return dict(zip(models, figures, strict=True))

    @property
    def _rounds(self) -> bool:
        """Whether the file holds other numbers than were learned."""
        return bool(formats.named(self.asked.out).keeps)

    @property
    def _as_learned(self) -> bool:
        """Whether figures are of the model before it was rounded: a part of it, or one chosen."""
        return self.shards > 1 or self.found is not None

    def report(self, figures: Mapping[str, dict[str, Any]]) -> Report:
        """Leave a record of figures as ``measured``, and say what came of it."""
        data = self._data(figures)
        asked, result, photographs = self.asked, self.result, self.opened.photographs
        text = self._text(data)
        more: dict[str, Any] = {"curves": [asdict(point) for point in result.curves]}
        if asked.itself:
            more["cameras"] = asked.scene.as_record(asked.cameras)
        if not result.interrupted:
            more |= {"configuration": self.opened.configuration, "text": text}
        scene = None
        if photographs is not None:
            scene = photographs.folder
            more["photographs"] = records.Recorded(photographs, (asked.model, asked.out)).as_dict()
        code = records.leave_or_tell(asked.out, asked.command, data | more)
        folder = output_folder(asked.out) or asked.out.parent
        then = wording.next_steps(asked.out, folder, scene)  # records name no folders
        return Report(data, f"{text}\n{then}", exit_code=130 if result.interrupted else code)

    def _data(self, figures: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
        """What the record and ``--json`` say; figures may be missing."""
        asked, result, settings = self.asked, self.result, self.result.settings
        after, control, done = figures.get("after", {}), figures.get("control"), result.progress
        if self.found is not None and self.found.control.progress.steps > done.steps:
            control = None  # it trained longer: the result was interrupted
        data: dict[str, Any] = {
            "model": str(asked.model),
            "out": str(asked.out),
            "target": after.get("target"),
            "before": figures.get("before"),
            "after": after or None,
            "untruncated": figures.get("untruncated"),
            "self": asked.itself,
            "seen": self.opened.seen,
            "pictures": self.opened.configuration["photographs"],
            "keep": asked.keep,
            "relocated": result.relocated,
            "forgotten": self.forgotten,
            "speedup": done.speedup,
            "faster": done.faster,
            "target_reached": done.target_reached,
            "interrupted": result.interrupted,
            "resumed_at": result.resumed_at,
            "already_finished": False,
            "iterations": done.steps,
            "pressure": done.pressure if settings.goal.presses else None,
            "train_seconds": result.train_seconds,
            "engine": result.engine,
            "device": after.get("device"),
            "adapter": None,
            "seed": asked.seed,
            "shards": self.shards,
            "settings": settings.as_dict(),
            "max_drop": None if self.found is None else self.found.as_dict(),
        }
        if control is None and after:
            control = records.control_of(data, records.files(asked.out.parent))
        return data | {"control": control}

    def _text(self, data: dict[str, Any]) -> str:
        """What a person reads."""
        result, settings, before = self.result, self.result.settings, data["before"]
        pressure = f" at pressure {data['pressure']:.2g}" if settings.goal.presses else ""
        lines = [
            wording.describe(wording.columns_of(data)),
            "",
            wording.outcome(self.asked.command, data, data["control"]),
            f"{result.engine} engine, {data['iterations']} iterations{pressure} in "
            f"{result.train_seconds:.0f} s.",
        ]
        if not self._rounds and (better := advise(data)) is not None:  # rounding lost it, maybe
            lines.append(better)
        if self.shards > 1:
            lines.append(
                f"{self.shards} processes held a part of the Gaussians each: a frame's time "
                "includes what they send each other."
            )
        if self.found is not None:
            lines.append(wording.bounded(data))
        if result.interrupted:
            of = f"{data['iterations']} of {settings.iterations}"
            lines.append(f"Interrupted at {of} iterations. {self._goes_on()}")
        lines += wording.begun(data)
        plain = data["untruncated"]
        if plain is not None:
            lines.append(describe_untruncated(before, plain))
        held = ", which holds the cutoffs" if plain else ""
        if settings.goal.on_area:
            held = ", which every viewer draws as it is"
        lines.append(describe_written(self.asked.out, held))
        if self._rounds and self._as_learned:
            lines.append("The figures above are of the model as it was learned, before rounding.")
        return "\n".join(lines)

    def terminated(self) -> Report:
        """The report after SIGTERM: the model is saved, and nothing is measured."""
        at = f"{self.result.progress.steps} of {self.result.settings.iterations} iterations"
        text = f"SIGTERM at {at}. Wrote {self.asked.out}. {self._goes_on()}"
        return Report(self._data({}), text, exit_code=EXIT_CODE)

    def _goes_on(self) -> str:
        if self.found is not None:
            return "With --max-drop the same command begins anew."
        # else it trains again
        trained = " with --stage finetune" if self.asked.command == "run" else ""
        return f"The same command{trained} goes on from there."


def finished(opened: Opened) -> Report | None:
    """The report of the same command, if it has written its ``--out`` already; else None."""
    model, out, record = opened.asked.model, opened.asked.out, None
    with contextlib.suppress(RecordError):
        record = records.beside(out) if out.is_file() else None
    if record is None or record.data.get("configuration") != opened.configuration:
        return None
    if Path(str(record.data.get("out"))).name != out.name:  # of the same name in another format
        return None
    data = {key: value for key, value in record.data.items() if key not in _OF_RECORDS}
    none, since = data.get("control"), records.control_of(data, records.files(out.parent))
    data["control"] = none or since
    said, now = (wording.outcome(record.command, data, each) for each in (none, none or since))
    text = (
        f"{record.data['text'].replace(said, now)}\n{out} was finished before: nothing was done. "
        "--again fine-tunes again."
    )
    given = {"model": str(model), "out": str(out)}  # the record names them from its own folder
    return Report(data | given | {"already_finished": True}, text)


def advise(data: dict[str, Any]) -> str | None:
    """A line for a model that lost what it knew as it came; None where nothing is left to try."""
    photographs = data["target"] != wording.ITSELF and data["shards"] == 1
    learned = data["pressure"] is not None and data["settings"]["train"] == "all"
    if not (photographs and learned) or data["after"]["psnr"] > data["before"]["psnr"] - LOST:
        return None
    more = [] if data["settings"]["dropout"] else [f"--dropout {DROPOUT:g}"]
    more += [f"--keep {KEEP:g}"] if data["keep"] in (None, "auto") else []
    if not more:
        return None
    return f"MODEL as it came shows the held-out views better: {' '.join(more)} may lose less."


def describe_untruncated(before: dict[str, Any], plain: dict[str, Any]) -> str:
    """A line on the fine-tuned model without its cutoffs."""
    own = plain["target"] == "itself"
    change = f"{plain['psnr']:.2f} dB PSNR ({plain['psnr'] - before['psnr']:+.2f})"
    shown = wording.quality(before, plain) if own else change
    least = wording.VISIBLE if own else before["psnr"] - wording.FELL
    advice = " For such viewers: --portable." if plain["psnr"] < least else ""
    return (
        f"In viewers that know no cutoffs: {shown}, {plain['fragments_per_pixel']:.1f} fragments "
        f"per pixel, {plain['frame_ms']:.2f} ± {plain['frame_ms_se']:.2f} ms a frame."
        f"{advice}"
    )
