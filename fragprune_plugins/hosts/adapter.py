"""What an adapter is: a description of one host. Patching and un-patching are the session's."""

from __future__ import annotations

import argparse
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

from fragprune_plugins.datasets.photographs import Photographs
from fragprune_plugins.errors import NotComparedError, UsageError
from fragprune_plugins.hosts.findings import Finding, Match
from fragprune_plugins.hosts.flags import Flags
from fragprune_plugins.hosts.seams import Seam, SeamCall
from fragprune_plugins.hosts.source import HostRepo, check_seams

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.engines import Engine
    from fragprune_plugins.types import RasterInputs, RasterOutputs

CHECKPOINT_KEY = "fragprune"
"""Under which a host's checkpoint carries thresholds."""


@dataclass(frozen=True)
class HostInfo:
    """Who the host is, for people.

    Attributes:
        title: the method's name.
        repo: owner/name of its public repository.
        states: the revisions this adapter was written for.
        limits: what will not work with this host, or is refused; a sentence each.
    """

    title: str
    repo: str
    states: str = ""
    limits: tuple[str, ...] = ()


@dataclass(frozen=True)
class HostCall:
    """The host's call of its rasterizer as data: positional or keyword, no matter.

    Attributes:
        settings: what the host configured its rasterizer with.
        arguments: of the call, by name.
        entry: the function called, "module:attribute" as seams spell it.
        engine: what draws it, for dialects that compute with it beforehand (``slice_at``).
    """

    settings: Any
    arguments: Mapping[str, Any]
    entry: str = ""
    engine: str | Engine = "auto"

    @classmethod
    def of(cls, call: SeamCall) -> HostCall:
        """The call of a rasterizer's seam; what it takes as ``**more`` as given."""
        settings = getattr(call.instance, "raster_settings", None)
        named = call.arguments
        return cls(settings, named | named.get("more", {}), str(call.seam))

    def get(self, name: str) -> Tensor | None:
        """A tensor argument; None when it is absent, None or empty (hosts pass all three)."""
        value: Tensor | None = self.arguments.get(name)
        return None if value is None or value.numel() == 0 else value

    def __getitem__(self, name: str) -> Tensor:
        value: Tensor = self.arguments[name]
        return value


class Dialect(ABC):
    """How one revision of a host calls its rasterizer, and what it expects back."""

    means: ClassVar[str] = "means3D"
    """What the call names the (N, 3) means."""

    @abstractmethod
    def unpack(self, call: HostCall) -> RasterInputs:
        """The host's call as core values."""

    def rows_drawn(self, model: Any, call: HostCall) -> Tensor | None:
        """Rows (M,) int64 of the model that a call draws, in its order; None for all.

        Raises:
            AlignmentError: the call's Gaussians cannot be told to be those rows.
        """
        return None

    @abstractmethod
    def pack(self, outputs: RasterOutputs, call: HostCall) -> Any:
        """What the host expects back, arity and all."""

    def answer(
        self, call: HostCall, inputs: RasterInputs, draw: Callable[..., RasterOutputs]
    ) -> Any:
        """Draw and pack; a dialect may draw several times where one picture does not say it all.

        Args:
            call: the host's.
            inputs: what ``unpack`` made of it.
            draw: rasterizes inputs, with the thresholds that apply to this call; where one call
                is of several cameras, a second argument numbers them from 0.
        """
        return self.pack(draw(inputs), call)

    @abstractmethod
    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """Stand-ins for the host's compiled packages, by import name.

        Args:
            draw: answers a host call without thresholds.
        """

    def names(self) -> frozenset[str]:
        """The import names that ``modules`` answers: their packages need not be installed."""
        return frozenset(self.modules(lambda call: None))

    def stands_in(self, call: HostCall) -> bool:
        """Whether ours must answer a call because the host's own function could not."""
        return False

    def present(self, package: str) -> bool:
        """Whether the host can import this compiled package of its own here."""
        try:
            return find_spec(package) is not None
        except ValueError:  # a module without a spec is a stand-in somebody else put there
            return True

    def spares(self) -> dict[str, ModuleType]:
        """Stand-ins for what the host imports and can do without, used on a CPU where absent."""
        return {}


@dataclass(frozen=True)
class ConfigFile:
    """A file whose values win over a host's command line; JSON, one object.

    Attributes:
        flag: that names it.
    """

    flag: str

    def read(self, path: Path) -> dict[str, Any]:
        """Values by argument name; OSError or ValueError where there is nothing to be read."""
        values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return values

    def overrule(self, text: str, values: dict[str, Any]) -> str:
        """The file's text with these values in place of its own."""
        return json.dumps(json.loads(text) | values)


def read_config(config: ConfigFile, path: Path) -> dict[str, Any]:
    """What a configuration file says, by argument name.

    Raises:
        UsageError: it cannot be read.
    """
    try:
        return config.read(path)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"{config.flag} {path}", str(error), "a file the host can read", "Correct the command."
        ) from error


@dataclass(frozen=True)
class CommandLine:
    """How a host's training script is told what we need to tell it, and tells what we must know.

    Attributes:
        scripts: paths of training scripts in the checkout, the usual one first; others (render.py)
            only get thresholds applied.
        iterations: flag, or its several spellings, of the total number of iterations.
        output: flags of the output folder.
        source: flags of the data folder.
        save_checkpoints: flag listing iterations to checkpoint at.
        resume: flag, or its several spellings, naming the file to resume from.
        default_iterations: of the host, read from its source.
        continues: those of the scripts that work on a checkpoint they are given: where ``resume``
            names one it is stage 1's, not ours to start stage 2 from.
        config: the file whose values the host puts over its command line, where it has one.
        checkpoints_only: no other file holds the model, so every stage asks for a last one.
        skipped: iterations of a run, fresh or resumed, in which no optimizer steps: hosts take no
            step in their last one. Stage 2 has as many more, and so all the steps it is asked for.
        restarts: there are no checkpoints: ``resume`` names a model's PLY, from which a new run
            begins. It counts from 0 and empties its output folder, so stage 2 gets one of its own.
        resolution: flags of the images' size, () where there are none.
        images: flags of the folder with the images, likewise.
        white_background: flags that ask for white behind transparent images, likewise.
        hold_out: flags without which no view is held out; () where views always are.
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
    restarts: bool = False
    resolution: tuple[str, ...] = ()
    images: tuple[str, ...] = ()
    white_background: tuple[str, ...] = ()
    hold_out: tuple[str, ...] = ()

    def spellings(self, field: str) -> tuple[str, ...]:
        """Every spelling of a flag, the one to use last."""
        flags = getattr(self, field)
        return (flags,) if isinstance(flags, str) else flags

    def read(self, arguments: list[str]) -> argparse.Namespace:
        """The values of the flags above, by field, as the host will read them; it reads them all.

        None (False for those without a value) where the command does not say.

        Raises:
            UsageError: a flag without its value, or a configuration file that cannot be read.
        """
        parser = Flags(add_help=False, conflict_handler="resolve")
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
        for name, options_of in options.items():
            if flags := self.spellings(name):
                parser.add_argument(*flags, dest=name, **options_of)
        if self.config:
            parser.add_argument(self.config.flag, dest="config", type=Path)
        values, _ = parser.parse_known_args(arguments, argparse.Namespace(**dict.fromkeys(options)))
        if self.config and values.config:
            written = read_config(self.config, values.config)
            for name in options:
                key = ("", *self.spellings(name))[-1].lstrip("-")
                setattr(values, name, written.get(key, getattr(values, name)))
        return values


class HostAdapter(ABC):
    """Describes one host: what identifies it, where to wrap, how its tensors are named.

    Subclasses are stateless; what depends on the revision comes from a ``HostRepo``. A host with
    training scripts has a ``ScriptAdapter``.

    Attributes:
        name: of the adapter, as ``--adapter`` takes it.
        info: who the host is, for people.
        seams: where to wrap.
        descends_from: names of adapters whose hosts this one was made from: where they fit too,
            they step back.
        installed: import names of the packages that are the host, where it is installed, not
            checked out.
        steps_by_rendering: the host does not call the STEP seam in every iteration: where it did
            not, the first view that it draws with gradients begins the step.
        appearance: param groups that hold the colour: ``--train appearance`` trains them besides.
        inherited: param groups that children have from their parents bit for bit, which is checked.
        gradients_read: param groups whose gradient the host reads in every iteration: frozen, they
            get zeros.
    """

    name: str
    info: HostInfo
    seams: tuple[Seam, ...]
    descends_from: tuple[str, ...] = ()
    installed: tuple[str, ...] = ()
    steps_by_rendering = False
    appearance: frozenset[str] = frozenset({"f_dc", "f_rest"})
    inherited: tuple[str, ...] = ()
    gradients_read: frozenset[str] = frozenset()

    # -- the source ------------------------------------------------------------------------------

    def seams_for(self, repo: HostRepo) -> tuple[Seam, ...]:
        """The seams of this revision; all of ``seams`` unless a host says otherwise."""
        return self.seams

    @abstractmethod
    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """What the source says about being this host; an error finding means it is not."""

    def match(self, repo: HostRepo) -> Match:
        """Fingerprint and seams together; an adapter that raises does not fit."""
        try:
            findings = [*self.fingerprint(repo), *check_seams(repo, self.seams_for(repo))]
        except Exception as error:  # the adapter's own; others are still tried
            findings = [
                Finding(
                    "error",
                    "adapter-failed",
                    f"adapter {self.name}",
                    f"{type(error).__name__}: {error}",
                    "an adapter that reads any folder",
                    "Report it to the adapter's author.",
                )
            ]
        fits = not any(finding.level == "error" for finding in findings)
        return Match(self.name, "known" if fits else "none", tuple(findings))

    @abstractmethod
    def dialect(self, repo: HostRepo) -> Dialect:
        """How this revision calls its rasterizer."""

    def use(self, repo: HostRepo) -> str:
        """What a user of this host types, for people to read."""
        package = self.installed[0] if self.installed else "the host"
        call = f'fragprune_plugins.activate("{self.name}")'
        return f"{call} above the import of {package} in your own script"

    # -- its models ------------------------------------------------------------------------------

    @abstractmethod
    def means(self, model: Any) -> Tensor:
        """(N, 3) the tensor the host hands its rasterizer: identifies the model."""

    @abstractmethod
    def opacities(self, model: Any) -> Tensor:
        """(N,) activated opacities."""

    def rows(self, model: Any) -> int:
        """How many Gaussians the model holds."""
        return len(self.means(model))

    def view(self, camera: Any) -> int:
        """Tells training views apart; by the object, unless a host draws through copies."""
        return id(camera)

    def model_of(self, call: SeamCall) -> Any:
        """The model that a seam's call is about: what the method was called on, unless a host has
        trainers, or functions, that change models.

        The tensor of its means will do where a call has no more; None where it is of no concern.
        """
        return call.instance

    def group_name(self, model: Any, group: Mapping[str, Any]) -> str | None:
        """What a param group is called in ``trained_groups``; None for one without a name."""
        return group.get("name")

    def trained_groups(self, train: str) -> frozenset[str] | None:
        """Names of param groups that stage 2 trains for ``--train``; None for all of them."""
        opacity = frozenset({"opacity"})
        return {"opacity": opacity, "appearance": opacity | self.appearance, "all": None}[train]

    def elsewhere(self, model: Any) -> list[Tensor]:
        """Parameters of an optimizer that is out of our reach, moved by what is drawn alone."""
        return []

    def prepare_stage2(self, model: Any, output: Path | None) -> None:  # noqa: B027 - optional
        """A chance to bring back state that the host's own resume loses."""

    def checkpoint_state(self, capture: Any) -> dict[str, Any]:
        """The dict inside the host's checkpoint tuple that tolerates a key of ours."""
        raise NotImplementedError(f"{self.name}: CAPTURE and RESTORE seams need checkpoint_state")


class ScriptAdapter(HostAdapter):
    """An adapter of a host with training scripts, which ``fragprune run`` drives."""

    @abstractmethod
    def command_line(self, repo: HostRepo) -> CommandLine:
        """How to drive the host's training script."""

    def use(self, repo: HostRepo) -> str:
        """What a user of this host types, for people to read."""
        script = self.command_line(repo).scripts[0]
        if not repo.package:
            return f"fragprune run -- python {repo.root / script} ..."
        module = script.removesuffix(".py").replace("/", ".")
        return f"fragprune run -- python -m {module} ..."

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """The command that can resume what a training script left; the same one by default."""
        return script, arguments

    def photographs(self, repo: HostRepo, arguments: list[str]) -> Photographs:
        """What a training command reads its photographs from, and how.

        Raises:
            NotComparedError: no view is held out, or our own readers would read them otherwise.
        """
        raise NotComparedError(
            self.name,
            "photographs that only the host knows how to read",
            "an adapter that says how",
            "Have the adapter define photographs().",
        )

    def drawing(self, repo: HostRepo, arguments: list[str]) -> dict[str, Any]:
        """How the finished model of a training command is drawn, beyond vanilla's rules.

        Returns:
            Fields of ``RasterInputs``.

        Raises:
            NotComparedError: our engines would draw it otherwise than the host.
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
        """Where the host saves its model at an iteration."""

    @abstractmethod
    def saved_iterations(self, output: Path) -> list[tuple[int, Path]]:
        """Resumable files of an output folder, (iteration, checkpoint or PLY), newest last."""

    @abstractmethod
    def checkpoint_from_ply(self, ply: Path, iteration: int, target: Path) -> None:
        """Write a checkpoint the host can resume from, made from its PLY."""
