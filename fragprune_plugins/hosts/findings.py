"""Results of reading a host: findings, and how well an adapter fits."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

from fragprune_plugins.hosts.seams import Seam


@dataclass(frozen=True)
class Finding:
    """An observation about a host or a removed patch, for print and JSON."""

    level: Literal["info", "warning", "error"]
    code: str
    where: str
    found: str
    expected: str = ""
    remedy: str = ""

    @classmethod
    def error(
        cls, code: str, where: object, found: str, expected: str = "", remedy: str = ""
    ) -> Finding:
        """A finding that speaks against the host."""
        return cls("error", code, str(where), found, expected, remedy)

    def __str__(self) -> str:
        expected = f"; expected {self.expected}" if self.expected else ""
        remedy = f". {self.remedy}" if self.remedy else ""
        return f"[{self.code}] {self.where}: {self.found}{expected}{remedy}"

    def as_dict(self) -> dict[str, str]:
        """Plain values, for ``--json``."""
        return asdict(self)


@dataclass(frozen=True)
class SeamState:
    """The state of a seam in the source; "at import" where that is compiled, and cannot tell."""

    seam: Seam
    status: Literal["found", "changed", "missing", "at import"]
    at: str = ""  # "file:line" of the function, or of the place where it was expected
    finding: Finding | None = None  # the error, where there is one


@dataclass(frozen=True)
class Match:
    """Whether one adapter fits one folder, with the findings and the state of each seam."""

    adapter: str
    fits: bool
    findings: tuple[Finding, ...] = ()
    seams: tuple[SeamState, ...] = ()

    @property
    def errors(self) -> list[Finding]:
        """What speaks against it."""
        return [finding for finding in self.findings if finding.level == "error"]

    @property
    def held(self) -> int:
        """The number of seams that are as the adapter needs them."""
        return sum(state.status == "found" for state in self.seams)

    @property
    def looked_up(self) -> int:
        """The number of seams that the source can decide."""
        return sum(state.status != "at import" for state in self.seams)

    def __str__(self) -> str:
        fits = "fits" if self.fits else "does not fit"
        return f"{self.adapter} {fits}: {self.held} of {self.looked_up} seams hold"

    def brief(self) -> str:
        """Whether it fits, and the first error, in one line."""
        return "; ".join([str(self), *(error.found for error in self.errors[:1])])


@dataclass(frozen=True)
class Plain:
    """Whether the PLY that a codebase saves is a plain 3DGS model.

    Attributes:
        reasons: what speaks against it, the weightiest first.
        model: class of the model; "" if there is none that saves a PLY.
        moved: those of the reasons that only say that the drawing function gets how to move the
            model's own Gaussians, of which it still draws each, or what it makes of the picture.
        folder: of the codebase in the checkout; "" for the checkout itself.
        elsewhere: where the model is, as text, if it is not where such codebases have it.
        unlike: why its pictures may differ from the photographs; "" if its training compares them.
    """

    reasons: tuple[str, ...]
    model: str = ""
    moved: frozenset[str] = frozenset()
    folder: str = ""
    elsewhere: str = ""
    unlike: str = ""

    def __bool__(self) -> bool:
        return bool(self.model) and not self.reasons
