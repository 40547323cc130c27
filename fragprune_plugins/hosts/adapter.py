"""An adapter describes one host. The session patches the host and restores it."""

from __future__ import annotations

import argparse
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from fragprune_plugins.errors import HostNeedsError, ModelFileError, NotComparedError, UsageError
from fragprune_plugins.files.reading import MEBIBYTE, UntrustedFile, parse_json
from fragprune_plugins.hosts.dialect import Dialect
from fragprune_plugins.hosts.findings import Finding, Match
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.hosts.preflight import Missing, install
from fragprune_plugins.hosts.seams import Seam, SeamCall
from fragprune_plugins.hosts.source import HostRepo, look_up

if TYPE_CHECKING:
    from torch import Tensor

CHECKPOINT_KEY = "fragprune"  # of thresholds, in the optimizer's state of a checkpoint


def optimizer_state(capture: Any, where: str) -> dict[str, Any]:
    """The first optimizer's state in a checkpoint, which keeps keys of ours, or ModelFileError."""
    for part in capture:
        if isinstance(part, dict) and "param_groups" in part:
            return part
    found, expected = "no optimizer's state in it", "one, as the host captures it"
    raise ModelFileError(where, found, expected, "Name another, or a PLY.")


@dataclass(frozen=True)
class ParamGroup:
    """A param group of the host's optimizer.

    Attributes:
        name: the host's name for it.
        colour: holds the colour, which ``--train appearance`` trains beside the opacity.
        copied: children copy it from their parents bit for bit, by which their parents are known.
        scheduled: the host sets its learning rate in every iteration, also in stage 2.
        named: the host's source spells the name out; otherwise the adapter's ``group_name`` does.
    """

    name: str
    colour: bool = False
    copied: bool = False
    scheduled: bool = False
    named: bool = True


GROUPS = (
    ParamGroup("xyz", scheduled=True),
    ParamGroup("f_dc", colour=True, copied=True),
    ParamGroup("f_rest", colour=True),
    ParamGroup("opacity"),
    ParamGroup("scaling"),
    ParamGroup("rotation", copied=True),
)
"""The groups of 3DGS, in order: ``load_state_dict`` matches them by position."""


@dataclass(frozen=True)
class HostInfo:
    """The host's name and limits, as text for people.

    Attributes:
        title: the method's name.
        repo: owner/name of its public repository.
        states: the revisions this adapter was written for.
        limits: things that do not work with this host or are refused, one sentence each.
        usage: the command that a user types, if it is another than ``fragprune run``.
    """

    title: str
    repo: str
    states: str = ""
    limits: tuple[str, ...] = ()
    usage: str = ""


@dataclass(frozen=True)
class ConfigFile:
    """A configuration file (one JSON object) whose values override the host's command line."""

    flag: str

    def read(self, path: Path) -> dict[str, Any]:
        """Values by argument name; raises anything if the file cannot be read."""
        values = parse_json(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError("not an object of names and values")
        return values

    def copied(self, path: Path, values: dict[str, Any]) -> str:
        """The text of a copy with these values, which may lie in any folder."""
        return json.dumps(json.loads(path.read_text(encoding="utf-8")) | values)


def read_config(config: ConfigFile, path: Path) -> dict[str, Any]:
    """Values of a configuration file by argument name, or HostNeedsError or UsageError."""
    remedy, expected = f"Correct {config.flag} {path}.", "a file the host can read"
    kind = UntrustedFile(UsageError, "unreadable", expected, remedy, limit=MEBIBYTE, missing=remedy)
    with kind.reading(path):
        try:
            return config.read(path)
        except ImportError as error:
            package = Missing((error.name or "").split(".")[0], str(path))
            needed, remedy = "a package with which the host reads it", install([package])
            raise HostNeedsError(f"{config.flag} {path}", str(error), needed, remedy) from error


class Flags(argparse.ArgumentParser):
    """An argument parser that raises UsageError; argparse would end the process."""

    def error(self, message: str) -> NoReturn:
        """Raise it."""
        expected, remedy = "flags the host understands", "Correct the command."
        raise UsageError("the host's command", message, expected, remedy)


@dataclass(frozen=True)
class CommandLine:
    """The flags of a host's training script that fragprune sets or reads.

    Attributes:
        scripts: paths of training scripts in the checkout, the usual one first. Other scripts, such
            as render.py, only draw with thresholds.
        iterations: the flag of the total number of iterations, or all its spellings.
        output: flags of the output folder.
        source: flags of the data folder.
        save_checkpoints: the flag that lists the iterations at which to checkpoint.
        resume: the flag that names the file to resume from, or all its spellings.
        default_iterations: the host's default, read from its source.
        continues: the scripts that always start from a given checkpoint. If ``resume`` names one,
            it belongs to stage 1, and stage 2 does not start from it.
        config: the file whose values override the command line; None if the host has none.
        checkpoints_only: only checkpoints hold the model, so every stage writes one at its end.
        skipped: number of iterations of a run without an optimizer step; hosts take none in their
            last one. Stage 2 runs as many extra iterations, so it makes all its steps.
        made: name of a checkpoint that is made from a PLY, with ``{}`` for the iteration.
        restarts: the host has no checkpoints. ``resume`` names a PLY, from which a new run begins.
            The run counts from 0 and empties its output folder, so stage 2 gets its own folder.
        resolution: flags of the images' size; () if there are none.
        images: flags of the folder with the images; () if there are none.
        white_background: flags for white behind transparent images; () if there are none.
        hold_out: flags that make the host hold views out; () if it always does.
        one_run: the host cannot resume a training, and ``resume`` names a model to evaluate.
            Stage 2 follows stage 1 in one run; see ``ScriptAdapter.lengthened``.
        in_full: a script's arguments with abbreviated flags written out; by default the same.
    """

    scripts: tuple[str, ...]
    iterations: str | tuple[str, ...]
    output: tuple[str, ...]
    source: tuple[str, ...]
    save_checkpoints: str
    resume: str | tuple[str, ...]
    default_iterations: int
    continues: tuple[str, ...] = ()
    config: ConfigFile | None = None
    checkpoints_only: bool = False
    skipped: int = 0
    made: str = ".fragprune_{}.pth"
    restarts: bool = False
    resolution: tuple[str, ...] = ()
    images: tuple[str, ...] = ()
    white_background: tuple[str, ...] = ()
    hold_out: tuple[str, ...] = ()
    one_run: bool = False
    in_full: Callable[[Path, list[str]], list[str]] = lambda script, arguments: arguments

    def spellings(self, field: str) -> tuple[str, ...]:
        """All spellings of a flag; the last one is the one to use."""
        flags = getattr(self, field)
        return (flags,) if isinstance(flags, str) else flags

    def read(self, arguments: list[str]) -> argparse.Namespace:
        """The values of the flags above by field, as the host reads them, or UsageError.

        A flag that the command lacks gives None, or False if it takes no value.
        """
        options: dict[str, dict[str, Any]] = {
            "resolution": {"type": int},
            "images": {},
            "white_background": {"action": "store_true"},
            "hold_out": {"action": "store_true"},
            "iterations": {"type": int},  # a spelling that two have is the later's
            "output": {},
            "source": {},
            "save_checkpoints": {"type": int, "nargs": "*"},
            "resume": {},
        }
        flags = {name: (self.spellings(name), more) for name, more in options.items()}
        return argparse.Namespace(**self.parsed(arguments, flags))

    def parsed(
        self, arguments: list[str], flags: Mapping[str, tuple[Sequence[str], dict[str, Any]]]
    ) -> dict[str, Any]:
        """Values of flags by name, as the host reads them, and "config", whose file wins."""
        parser = Flags(add_help=False, allow_abbrev=False, conflict_handler="resolve")
        for name, (spellings, more) in flags.items():
            if spellings:
                parser.add_argument(*spellings, dest=name, **more)
        if self.config:
            parser.add_argument(self.config.flag, dest="config", type=Path)
        given = vars(parser.parse_known_args(arguments)[0])
        file = self.config and given["config"]
        written = read_config(self.config, file) if self.config and file else {}
        keys = {name: ("", *spellings)[-1].lstrip("-") for name, (spellings, _) in flags.items()}
        return given | {name: written.get(key, given.get(name)) for name, key in keys.items()}


class HostAdapter(ABC):
    """Describes one host: how to recognise it, which functions to wrap, how its tensors are named.

    Subclasses are stateless; anything that depends on the revision comes from a ``HostRepo``. A
    host with training scripts has a ``ScriptAdapter``.

    Attributes:
        name: the adapter's name, for ``--adapter``.
        info: the host's name and limits, as text for people.
        seams: the functions to wrap.
        descends_from: names of the adapters of this host's ancestors. If an ancestor's adapter fits
            too, this one is chosen.
        installed: import names of the host's packages, if it is installed instead of checked out.
        steps_by_rendering: the host does not call the STEP seam in every iteration. In an iteration
            without that call, the first view drawn with gradients begins the step.
        groups: param groups of the host's main optimizer, in order.
        on_gpu: our cuda engine can draw its Gaussians. If not, ``fragprune run`` refuses a GPU for
            what draws with thresholds.
    """

    name: str
    info: HostInfo
    seams: tuple[Seam, ...]
    descends_from: tuple[str, ...] = ()
    installed: tuple[str, ...] = ()
    steps_by_rendering = False
    groups: tuple[ParamGroup, ...] = GROUPS
    on_gpu: bool = True

    def seams_for(self, repo: HostRepo) -> tuple[Seam, ...]:
        """The seams of this revision; by default all of ``seams``."""
        return self.seams

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """Findings on whether the source is this host; an error finding means that it is not.

        By default it is if it is an installed package of this host.
        """
        if repo.package in self.installed:
            return [Finding("info", "revision", repo.package, repo.commit)]
        expected = f"the installed package {self.installed[0]}, or a script that imports it"
        remedy = f"Train with: {self.info.usage}" if self.info.usage else ""
        return [Finding.error("other-host", repo.root, "a folder, not a package", expected, remedy)]

    def match(self, repo: HostRepo) -> Match:
        """Check fingerprint and seams. An adapter that raises does not fit."""
        try:
            seams = [look_up(repo, seam) for seam in self.seams_for(repo)]
            findings = [*self.fingerprint(repo), *(each.finding for each in seams if each.finding)]
        except Exception as error:  # the adapter's own; others are still tried
            found = f"{type(error).__name__}: {error}"
            where, expected = f"adapter {self.name}", "an adapter that reads any folder"
            remedy = "Report it to the adapter's author."
            failed = Finding.error("adapter-failed", where, found, expected, remedy)
            return Match(self.name, False, (failed,))
        fits = not any(finding.level == "error" for finding in findings)
        return Match(self.name, fits, tuple(findings), tuple(seams))

    @abstractmethod
    def dialect(self, repo: HostRepo) -> Dialect:
        """The dialect of this revision's rasterizer call."""

    def trainer(self, repo: HostRepo, script: Path) -> ScriptAdapter | Callable[..., Any] | None:
        """What runs a training script of this host under ``fragprune run``; None if nothing does.

        A ``ScriptAdapter``, or a function that runs the command itself: it gets the script, its
        arguments, the module's name and the ``RunOptions``, and returns a ``RunSummary``. A script
        may be outside the host and import it.
        """
        return None

    @abstractmethod
    def means(self, model: Any) -> Tensor:
        """(N, 3) the tensor that the host passes to its rasterizer; it identifies the model."""

    @abstractmethod
    def opacities(self, model: Any) -> Tensor:
        """(N,) activated opacities."""

    def view(self, camera: Any) -> Hashable:
        """A key of a training view, or a tuple of several; by default the camera's id."""
        return id(camera)

    def model_of(self, call: SeamCall) -> Any:
        """The model of a seam's call, or its means' tensor; by default the object of the method.

        Override this for hosts with trainers or functions that change models. None if the call
        concerns no model of ours.
        """
        return call.instance

    def group_name(self, model: Any, group: Mapping[str, Any]) -> str | None:
        """The name of a param group, as in ``groups``; None if it has none."""
        return group.get("name")

    def extra_parameters(self, model: Any) -> list[Tensor]:
        """Trained parameters outside the known optimizers, which drawing alone moves."""
        return []

    def prepare_stage2(self, model: Any, start: Path | None) -> None:  # noqa: B027 - optional
        """Restore state that the host's own resume loses.

        Args:
            start: the checkpoint or PLY that stage 2 resumes; None if it follows in one run.
        """


class ScriptAdapter(HostAdapter):
    """An adapter of a host with training scripts, which ``fragprune run`` drives."""

    @abstractmethod
    def command_line(self, repo: HostRepo) -> CommandLine:
        """The flags of the host's training script."""

    def trainer(self, repo: HostRepo, script: Path) -> ScriptAdapter | Callable[..., Any] | None:
        """This adapter."""
        return self

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """The command that can resume a training script's result; by default the same command."""
        return script, arguments

    def refuse(self, repo: HostRepo, arguments: list[str], *, stage: str, device: str) -> None:
        """Refuse, before stage 1, arguments of a training that stage 2 cannot follow.

        Args:
            stage: "auto", "finetune" or "joint".
            device: "cpu", "cuda" or "cuda:N".

        Raises:
            UsageError: names the argument.
        """

    def lengthened(self, arguments: list[str], first: int, last: int) -> list[str]:
        """Arguments of a host that cannot resume (``CommandLine.one_run``) for a longer training.

        It also saves at iteration ``first``, its own end, and stage 2 ends at ``last``.
        """
        raise NotImplementedError(f"{self.name}: one_run needs lengthened()")

    def expect_resumable(self, checkpoint: Path) -> None:
        """Raise UsageError unless the host can resume from this file and count on from it."""

    def densified(self, repo: HostRepo, script: Path, arguments: list[str]) -> int | None:
        """The iteration after which a training adds, relocates, prunes and resets no Gaussian.

        ``--stage joint`` learns from there by default. None if arguments do not tell, or if never.
        """
        return None

    def photographs(self, repo: HostRepo, arguments: list[str]) -> Photographs:
        """The photographs that a training command reads.

        Raises:
            NotComparedError: our readers would read the images differently.
        """
        found, expected = "photographs that only the host can read", "an adapter with photographs()"
        raise NotComparedError(self.name, found, expected, "Define photographs() in the adapter.")

    def drawing(self, repo: HostRepo, arguments: list[str]) -> dict[str, Any]:
        """Fields of ``RasterInputs`` for a training's model, where vanilla's rules do not apply.

        Raises:
            NotComparedError: our engines would draw the model differently from the host.
        """
        return {}

    def save_model(self, model: Any, output: Path, iteration: int) -> Path:
        """Have the host save its model as it would at this iteration; returns the file."""
        path = self.model_file(output, iteration)
        path.parent.mkdir(parents=True, exist_ok=True)
        model.save_ply(str(path))
        return path

    @abstractmethod
    def model_file(self, output: Path, iteration: int) -> Path:
        """The file to which the host saves its model at an iteration."""

    def saved_iterations(self, output: Path) -> list[tuple[int, Path]]:
        """(iteration, checkpoint or PLY) to resume from in an output folder, newest last."""
        return []

    def checkpoint_from_ply(self, ply: Path, iteration: int, target: Path) -> None:
        """Make a checkpoint to resume from a PLY of the host; UsageError if the host cannot."""
        found = f"a PLY, from which {self.info.title} cannot resume"
        remedy = "Name one with its flag for that, or prune the PLY: fragprune finetune."
        raise UsageError(str(ply), found, "a checkpoint of its own training", remedy)
