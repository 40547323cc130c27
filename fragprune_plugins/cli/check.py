"""``fragprune check``: which adapter fits a codebase, from its source alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fragprune_plugins.cli.common import FILE, Command, Report

if TYPE_CHECKING:
    from fragprune_plugins.hosts.adapter import HostAdapter
    from fragprune_plugins.hosts.findings import Finding, Match
    from fragprune_plugins.hosts.source import HostRepo, SeamState


@click.command("check", cls=Command)
@click.argument("host", type=FILE)
@click.option("--adapter", help="Check this adapter only.")
def command(host: Path, adapter: str | None) -> Report:
    """Read HOST, a training repository, and say which adapter fits and what speaks against it.

    Nothing is imported or run; no GPU is needed. Of every seam it says in which file and line it
    was found, changed, or expected, and for the adapter that fits also what will not work. Exit
    code 0 when exactly one adapter fits.

    \b
    Examples:
      fragprune check ~/code/gaussian-splatting
      fragprune check ~/code/my-fork --adapter vanilla-3dgs     (why does it not fit?)
      fragprune check gsplat                                    (an installed package)
    """
    from fragprune_plugins.errors import UnknownHostError
    from fragprune_plugins.hosts.source import HostRepo
    from fragprune_plugins.plugins.loading import load_plugins

    if not host.is_dir() and HostRepo.installed(str(host)) is None:
        raise UnknownHostError(
            str(host),
            "neither a folder nor an installed package",
            "a host's checkout, or the import name of a host that is installed",
            "Name the folder of train.py.",
        )
    adapters = load_plugins().adapters
    if adapter is not None:
        adapters = [a for a in adapters if a.name == adapter.replace("_", "-")]
        if not adapters:
            raise UnknownHostError(
                "--adapter", repr(adapter), "an installed adapter", "Run fragprune adapters."
            )
    repo = _repository(host, adapters, adapter)
    checked = sorted((_check(each, repo) for each in adapters), key=lambda each: each.order)
    fitting = [each for each in checked if each.match.fits]
    verdict = fitting[0] if len(fitting) == 1 else None
    lines = [f"{repo.root}" + (f", commit {repo.commit}" if repo.commit else "")]
    known = fitting or [each for each in checked if each.held or adapter]
    shown = fitting or known[:1]
    for each in shown:
        lines += ["", *each.lines()]
    if len(checked) > len(shown):
        lines += ["", "Others:" if shown else "None of these adapters finds anything of its host:"]
    lines += [f"  {each.headline()}" for each in checked if each not in shown]
    lines += ["", _conclusion(repo, fitting)]
    data = {
        "host": str(host),
        "commit": repo.commit,
        "fits": verdict.adapter.name if verdict else None,
        "adapters": [each.as_dict() for each in checked],
    }
    return Report(data, "\n".join(lines), exit_code=0 if verdict else 1)


_SIGNS = {"missing": "MISSING in", "changed": "CHANGED at", "at import": "(checked at import)"}


@dataclass(frozen=True)
class _Checked:
    """One adapter tried on one codebase."""

    adapter: HostAdapter
    match: Match
    seams: list[SeamState]

    @property
    def held(self) -> int:
        """Seams that are as the adapter needs them."""
        return sum(state.status == "found" for state in self.seams)

    @property
    def looked_up(self) -> int:
        """Seams that source can tell about."""
        return sum(state.status != "at import" for state in self.seams)

    @property
    def order(self) -> tuple[int, float, int]:
        """By kinds of errors, then by the share of seams that hold, then by how much is wrong."""
        kinds = {finding.code for finding in self.errors}
        complaint = sum(len(finding.found) for finding in self.errors)
        return len(kinds), -self.held / max(1, self.looked_up), complaint

    @property
    def errors(self) -> list[Finding]:
        """What speaks against the adapter."""
        return [finding for finding in self.match.findings if finding.level == "error"]

    def verdict(self) -> str:
        """Whether it fits, and how much of it."""
        return (
            f"{self.adapter.name} {'fits' if self.match.fits else 'does not fit'}: "
            f"{self.held} of {self.looked_up} seams hold"
        )

    def headline(self) -> str:
        """The verdict, and where it is no, the first reason."""
        return self.verdict() + (f"; {self.errors[0]}" if self.errors else "")

    def lines(self) -> list[str]:
        """Everything, for a person."""
        info, of_seams = self.adapter.info, [state.finding for state in self.seams]
        lines = [f"{self.verdict()} ({info.title}, {info.repo})"]
        lines += [f"  {each}" for each in self.match.findings if each not in of_seams]
        for state in self.seams:
            at = state.at if state.status == "found" else f"{_SIGNS[state.status]} {state.at}"
            if state.finding and state.status == "changed":
                at += f": {state.finding.found}; expected {state.finding.expected}"
            lines.append(f"  {state.seam.role.name.lower():<10} {state.seam!s:<62} {at.strip()}")
        if self.match.fits and self.adapter.info.limits:
            lines += ["  What will not work:"]
            lines += [f"  - {limit}" for limit in self.adapter.info.limits]
        return lines

    def as_dict(self) -> dict[str, Any]:
        """Everything, for --json."""
        return {
            "adapter": self.adapter.name,
            "confidence": self.match.confidence,
            "seams_held": self.held,
            "seams_looked_up": self.looked_up,
            "findings": [finding.as_dict() for finding in self.match.findings],
            "limits": list(self.adapter.info.limits),
            "seams": [
                {
                    "role": state.seam.role.name,
                    "seam": str(state.seam),
                    "status": state.status,
                    "at": state.at,
                }
                for state in self.seams
            ],
        }


def _repository(host: Path, adapters: list[HostAdapter], name: str | None) -> HostRepo:
    """The checkout that the folder is or lies in, or the package; else the folder itself."""
    from fragprune_plugins.errors import UnknownHostError
    from fragprune_plugins.hosts.choosing import locate
    from fragprune_plugins.hosts.source import HostRepo

    package = None if host.is_dir() else HostRepo.installed(str(host))
    if package is not None:
        return package
    try:
        return locate(host, adapters, name)[0]
    except UnknownHostError:
        return HostRepo(host)


def _check(adapter: HostAdapter, repo: HostRepo) -> _Checked:
    from fragprune_plugins.hosts.source import look_up

    return _Checked(adapter, adapter.match(repo), look_up(repo, adapter.seams_for(repo)))


def _conclusion(repo: HostRepo, fitting: list[_Checked]) -> str:
    if len(fitting) == 1:
        return f"Use: {fitting[0].adapter.use(repo)}"
    if fitting:
        names = ", ".join(each.adapter.name for each in fitting)
        return f"Several adapters fit: {names}. Name one with fragprune run --adapter."
    return "No adapter fits. docs/how-to/write-an-adapter.md says how to write one."
