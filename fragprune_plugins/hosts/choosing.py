"""Chooses the adapter of a checkout: the named one, or the only one that fits."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence

from fragprune_plugins.errors import UnknownHostError
from fragprune_plugins.hosts.adapter import HostAdapter, ScriptAdapter
from fragprune_plugins.hosts.findings import Match
from fragprune_plugins.hosts.source import HostRepo


def attempt(repo: HostRepo, adapters: Sequence[HostAdapter]) -> dict[HostAdapter, Match]:
    """Try each adapter on a codebase; the best fit comes first.

    By the share of seams that hold, then by the kinds and by the size of the errors.
    """

    def order(tried: tuple[HostAdapter, Match]) -> tuple[bool, float, int, int]:
        match = tried[1]
        share = match.held / max(1, match.looked_up)
        kinds = {finding.code for finding in match.errors}
        return not match.fits, -share, len(kinds), sum(len(each.found) for each in match.errors)

    return dict(sorted(((each, each.match(repo)) for each in adapters), key=order))


def locate(
    repo: HostRepo,
    adapters: Sequence[HostAdapter],
    name: str | None = None,
    select: Callable[..., str | None] | None = None,
    *,
    above: bool = True,
) -> tuple[HostRepo, HostAdapter]:
    """Find the checkout that is a script's folder or contains it, and its adapter; see ``choose``.

    If no adapter finds a seam in it, it is an installed package that scripts import, or that of the
    adapter ``name``. With ``above`` the folder above counts, if scripts import from it.
    """
    try:
        return repo, choose(repo, adapters, name, select)
    except UnknownHostError:
        taken = [each for each in repo.imported if not (name or (repo.root / each).is_dir())]
        used = [
            package
            for adapter in adapters
            for package in adapter.installed[:1]
            if (name or "").replace("_", "-") == adapter.name
            or (package in taken and "own-host" not in {e.code for e in adapter.match(repo).errors})
        ]
        if used and not name and any(each.held for each in attempt(repo, adapters).values()):
            raise  # a host of its own, that draws by that package
        packages = [package for each in used if (package := HostRepo.installed(each))]
        for candidate in (*(folder_above(repo) if above else ()), *packages):
            with contextlib.suppress(UnknownHostError):
                return candidate, choose(candidate, adapters, name, select)
        raise


def folder_above(repo: HostRepo) -> list[HostRepo]:
    """The folder above, if scripts import what lies in it, and no packages are installed there."""
    above = HostRepo(repo.root.parent)
    used = any(map(above.path, repo.imported)) and not any(above.root.glob("*.dist-info"))
    return [above] if used else []


def choose(
    repo: HostRepo,
    adapters: Sequence[HostAdapter],
    name: str | None = None,
    select: Callable[..., str | None] | None = None,
) -> HostAdapter:
    """Choose the adapter for a checkout: the named one, or the only one that fits.

    If those of a host and of its ancestor fit, the host's is chosen. ``select`` breaks a tie.

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
        return next(iter(fitting))
    if not fitting:
        others = [a.name for a in adapters if a not in wanted and a.match(repo).fits]
        found, expected = f"no adapter fits ({_nearest(tried)})", "one that an adapter knows"
        remedy = "Run fragprune check on the folder to see more, or write an adapter."
        remedy = f"Choose {' or '.join(others)}, which fits." if others else remedy
        raise UnknownHostError(str(repo.root), found, expected, remedy)
    selected = select(repo=repo, matches=[*fitting.values()]) if select else None
    if chosen := [each for each in fitting if each.name == selected]:
        return chosen[0]
    found = f"several adapters fit: {', '.join(each.name for each in fitting)}"
    raise UnknownHostError(str(repo.root), found, "one", "Name it with --adapter.")


def _nearest(tried: Mapping[HostAdapter, Match]) -> str:
    """The first error of the adapter that comes nearest."""
    if not tried:
        return "none is installed"
    best = next(iter(tried.values()))
    if len(tried) == 1:
        return f"{best.adapter}: {'; '.join(map(str, best.errors[:1]))}"
    return f"the nearest, {best.brief()}" if best.held else "none finds anything of its host"


def closest(
    tried: Mapping[HostAdapter, Match], adapters: Sequence[HostAdapter]
) -> dict[HostAdapter, Match]:
    """The adapters that fit, without those that are ancestors of another one."""
    fitting = {each: match for each, match in tried.items() if match.fits}
    parents = {each.name: each.descends_from for each in adapters}
    ancestors: list[str] = [name for each in fitting for name in each.descends_from]
    for name in ancestors:  # it grows
        ancestors += (each for each in parents.get(name, ()) if each not in ancestors)
    nearest = {each: match for each, match in fitting.items() if each.name not in ancestors}
    return nearest or fitting


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
