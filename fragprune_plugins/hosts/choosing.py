"""Chooses the adapter of a checkout: the named one, or the only one that fits."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fragprune_plugins.errors import UnknownHostError
from fragprune_plugins.hosts.adapter import HostAdapter, ScriptAdapter
from fragprune_plugins.hosts.findings import Finding, Match
from fragprune_plugins.hosts.source import HostRepo, imported


@dataclass(frozen=True)
class Attempt:
    """The result of one adapter on one codebase."""

    adapter: HostAdapter
    match: Match

    @property
    def held(self) -> int:
        """The number of seams that are as the adapter needs them."""
        return sum(state.status == "found" for state in self.match.seams)

    @property
    def looked_up(self) -> int:
        """The number of seams that the source can decide."""
        return sum(state.status != "at import" for state in self.match.seams)

    @property
    def order(self) -> tuple[bool, float, int, int]:
        """Sort key: fits, share of seams that hold, kinds of errors, size of the errors."""
        kinds = {finding.code for finding in self.errors}
        complaint = sum(len(finding.found) for finding in self.errors)
        share = self.held / max(1, self.looked_up)
        return not self.match.fits, -share, len(kinds), complaint

    @property
    def errors(self) -> list[Finding]:
        """The errors of the adapter on this codebase."""
        return [finding for finding in self.match.findings if finding.level == "error"]

    def verdict(self) -> str:
        """Whether the adapter fits, and how many seams hold, as text."""
        return (
            f"{self.adapter.name} {'fits' if self.match.fits else 'does not fit'}: "
            f"{self.held} of {self.looked_up} seams hold"
        )

    def brief(self) -> str:
        """The verdict and the first error, if any, in one line."""
        return self.verdict() + (f"; {self.errors[0].found}" if self.errors else "")


def attempt(repo: HostRepo, adapters: Sequence[HostAdapter]) -> list[Attempt]:
    """Try each adapter on a codebase; returns the results, best fit first."""
    tried = (Attempt(adapter, adapter.match(repo)) for adapter in adapters)
    return sorted(tried, key=lambda each: each.order)


def locate(
    repo: HostRepo,
    adapters: Sequence[HostAdapter],
    name: str | None = None,
    select: Callable[..., str | None] | None = None,
    *,
    above: bool = True,
) -> tuple[HostRepo, HostAdapter]:
    """Find the checkout that is a script's folder or contains it, and its adapter; see ``choose``.

    If no adapter finds a seam in it, but its scripts import an installed host, or ``name`` is the
    adapter of an installed host, the result is the installed package. With ``above`` the folder
    that contains this one is looked at, too, if scripts here import what lies in it.
    """
    try:
        return repo, choose(repo, adapters, name, select)
    except UnknownHostError:
        named = name and name.replace("_", "-")
        used = [
            package
            for adapter in adapters
            for package in adapter.installed[:1]
            if named == adapter.name
            or (not name and repo.imports(package) and not (repo.root / package).is_dir())
        ]
        if used and not name and any(each.held for each in attempt(repo, adapters)):
            raise  # a host of its own, that draws by that package
        packages = [package for each in used if (package := HostRepo.installed(each))]
        for candidate in (*(folder_above(repo) if above else ()), *packages):
            with contextlib.suppress(UnknownHostError):
                return candidate, choose(candidate, adapters, name, select)
        raise


def folder_above(repo: HostRepo) -> list[HostRepo]:
    """The folder above, which may hold all that its user has, if scripts import what lies in it."""
    above = HostRepo(repo.root.parent)
    used = {name for each in repo.root.glob("*.py") for name in imported(repo.tree(each.stem))}
    return [above] if any(map(above.path, used)) else []


def choose(
    repo: HostRepo,
    adapters: Sequence[HostAdapter],
    name: str | None = None,
    select: Callable[..., str | None] | None = None,
) -> HostAdapter:
    """Choose the adapter for a checkout: the named one, or the only one that fits.

    If the adapters of a host and of its ancestor both fit, the host's is chosen (``closest``).

    Args:
        select: breaks a tie; the hook ``fragprune_select_adapter``.

    Raises:
        UnknownHostError: no adapter fits, the named one does not fit, or several fit.
    """
    wanted = [each for each in adapters if name is None or each.name == name.replace("_", "-")]
    if name is not None and not wanted:
        names = ", ".join(sorted(each.name for each in adapters)) or "none"
        raise UnknownHostError("--adapter", repr(name), f"one of {names}", "Choose one.")
    tried = attempt(repo, wanted)
    fitting = closest(tried, adapters)
    if len(fitting) == 1:
        return fitting[0].adapter
    if not fitting:
        others = [a.name for a in adapters if a not in wanted and a.match(repo).fits]
        found, expected = f"no adapter fits ({_nearest(tried)})", "one that an adapter knows"
        remedy = "Run fragprune check on the folder to see more, or write an adapter."
        remedy = f"Choose {' or '.join(others)}, which fits." if others else remedy
        raise UnknownHostError(str(repo.root), found, expected, remedy)
    selected = select(repo=repo, matches=[each.match for each in fitting]) if select else None
    for each in fitting:
        if each.adapter.name == selected:
            return each.adapter
    found = f"several adapters fit: {', '.join(each.adapter.name for each in fitting)}"
    raise UnknownHostError(str(repo.root), found, "one", "Name it with --adapter.")


def _nearest(tried: Sequence[Attempt]) -> str:
    """The errors of the adapter that comes nearest, the first."""
    if not tried:
        return "none is installed"
    best = tried[0]
    if len(tried) == 1:
        return f"{best.adapter.name}: {'; '.join(map(str, best.errors[:1]))}"
    return f"the nearest, {best.brief()}" if best.held else "none finds anything of its host"


def closest(tried: Sequence[Attempt], adapters: Sequence[HostAdapter]) -> list[Attempt]:
    """The adapters that fit, without those that are ancestors of another one."""
    fitting = [each for each in tried if each.match.fits]
    parents = {adapter.name: adapter.descends_from for adapter in adapters}
    ancestors: set[str] = set()
    for each in fitting:
        new = set(each.adapter.descends_from)
        while new := new - ancestors:
            ancestors |= new
            new = {name for one in new for name in parents.get(one, ())}
    return [each for each in fitting if each.adapter.name not in ancestors] or fitting


def usage(adapter: HostAdapter, repo: HostRepo) -> str:
    """The command that a user of a host types, as text for people."""
    if adapter.info.usage:
        return adapter.info.usage
    if not isinstance(adapter, ScriptAdapter):
        package = adapter.installed[0] if adapter.installed else "the host"
        call = f'fragprune_plugins.activate("{adapter.name}")'
        return f"{call} above the import of {package} in your own script"
    script = adapter.command_line(repo).scripts[0]
    if not repo.package:
        return f"fragprune run -- python {repo.root / script} ..."
    module = script.removesuffix(".py").replace("/", ".")
    return f"fragprune run -- python -m {module} ..."
