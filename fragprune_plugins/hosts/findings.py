"""Results of reading a host: findings, and how well an adapter fits."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """An observation about a host or a removed patch, for print and JSON."""

    level: Literal["info", "warning", "error"]
    code: str
    where: str
    found: str
    expected: str = ""
    remedy: str = ""

    def __str__(self) -> str:
        parts = [f"[{self.code}] {self.where}: {self.found}"]
        if self.expected:
            parts.append(f"expected {self.expected}")
        return "; ".join(parts) + (f". {self.remedy}" if self.remedy else "")

    def as_dict(self) -> dict[str, str]:
        """Plain values, for ``--json``."""
        return asdict(self)


@dataclass(frozen=True)
class Match:
    """Whether one adapter fits one folder, with the findings."""

    adapter: str
    fits: bool
    findings: tuple[Finding, ...] = ()
