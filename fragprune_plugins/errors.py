"""The log, and every error a user can meet: where, what was found, expected, what to do."""

from __future__ import annotations

import logging
import re
from typing import ClassVar, Final

log: Final = logging.getLogger("fragprune")
"""Where every module tells what is no error."""


def printable(text: str) -> str:
    """A text with escapes for what would control a terminal, or cannot be encoded.

    Messages quote names from untrusted files.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in text)


class FragpruneError(Exception):
    """Base of all stated failures; the command line prints it without a traceback, exit code 1.

    Args:
        where: file, seam or option that the error is about.
        found: what was there.
        expected: what should have been there.
        remedy: the next thing to do, in the imperative.
    """

    code: ClassVar[str] = "error"

    def __init_subclass__(cls) -> None:
        """Without a code of its own an error is called after its class: ``model-file``."""
        if "code" not in vars(cls):
            words = re.findall("[A-Z][a-z]*", cls.__name__.removesuffix("Error"))
            cls.code = "-".join(words).lower()

    def __init__(self, where: str, found: str, expected: str, remedy: str) -> None:
        self.where, self.found = printable(where), printable(found)
        self.expected, self.remedy = printable(expected), printable(remedy)
        said = f"{self.where}: {self.found}; expected {self.expected}. {self.remedy}"
        super().__init__(f"[{self.code}] {said}")

    def as_dict(self) -> dict[str, str]:
        """The message's parts, for ``--json``."""
        parts = ("code", "where", "found", "expected", "remedy")
        return {name: getattr(self, name) for name in parts}


class ModelFileError(FragpruneError):
    """A PLY that is missing, truncated, empty, not finite, or not a Gaussian splat."""


class DatasetError(FragpruneError):
    """Photographs or cameras that are missing, of an unknown kind, or do not match each other."""


class SidecarError(FragpruneError):
    """A sidecar that is lost, broken, not finite, or belongs to another model."""


class CheckpointError(FragpruneError):
    """A fine-tuning's checkpoint that is broken, not finite, or of another fine-tuning."""


class OutputError(FragpruneError):
    """A place that cannot be written."""


class AlignmentError(FragpruneError):
    """Thresholds and Gaussians no longer correspond row by row."""

    code = "row-mismatch"


class UnknownHostError(FragpruneError):
    """No adapter fits the codebase."""


class HostNeedsError(FragpruneError):
    """Packages that a host imports, or the data it is to read, are missing."""


class HostFailed(FragpruneError):  # noqa: N818 - the host's failure, reported
    """The host's script raised, or ended with a non-zero exit code."""


class ProofError(FragpruneError):
    """A host's own rasterizer draws, or differentiates, otherwise than our engine does."""


class SeamError(FragpruneError):
    """A host lacks a function that we wrap, or the function has other parameters."""


class LateImportError(FragpruneError):
    """The host imported a function that we must wrap before we were activated."""


class SessionError(FragpruneError):
    """Activation out of order: a second session while one is active, or no active session."""


class RanksError(FragpruneError):
    """Several processes (torchrun, DDP) that cannot learn one model together, or parted."""


class EngineError(FragpruneError):
    """No engine on this machine can do the task."""


class KernelError(EngineError):
    """Kernels cannot be compiled for a GPU, or loaded into it."""


class InputError(FragpruneError):
    """Tensors of the wrong shape, dtype or device."""


class PluginError(FragpruneError):
    """A plugin that raised in a hook, or gave an answer that cannot be used."""


class RecordError(FragpruneError):
    """There is no record to report, or a record cannot be read."""


class PathError(FragpruneError):
    """A path that the system refuses: too long a name, no permission, no space left."""


class MemoryLimitError(FragpruneError):
    """A command needs more memory than the machine gives it."""

    code = "memory"


class NotComparedError(FragpruneError):
    """A host's run cannot be measured on its held-out views."""


class DivergedError(FragpruneError):
    """Learned values are NaN or infinite; none of them is saved."""

    code = "not-finite"


class ResetError(FragpruneError):
    """Thresholds would begin to learn right after the host has reset its opacities."""

    code = "opacity-reset"


class UsageError(FragpruneError):
    """Options that contradict each other; exit code 2."""


class Interrupted(FragpruneError):  # noqa: N818 - a person's wish, not a fault
    """Ctrl-C during stage 2; the learned values are saved first. Exit code 130."""


class Terminated(Interrupted):
    """SIGTERM during stage 2; the learned values are saved first. Exit code 143."""
