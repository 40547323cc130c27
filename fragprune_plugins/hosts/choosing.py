"""Chooses the adapter of a checkout: the one asked for, or the only one that fits."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path

from fragprune_plugins.errors import UnknownHostError
from fragprune_plugins.hosts.adapter import HostAdapter
from fragprune_plugins.hosts.source import HostRepo


def locate(
    folder: Path,
    adapters: Sequence[HostAdapter],
    name: str | None = None,
    select: Callable[..., str | None] | None = None,
) -> tuple[HostRepo, HostAdapter]:
    """The checkout that a script's folder is, or lies in, and its adapter; see ``choose``.

    Where that is no host but its scripts import one that is installed, or ``name`` is the adapter
    of such a one, the installed package.
    """
    repo, above = HostRepo(folder), HostRepo(folder.resolve().parent)
    try:
        return repo, choose(repo, adapters, name, select)
    except UnknownHostError:
        used = [
            package
            for adapter in adapters
            for package in adapter.installed[:1]
            if (name.replace("_", "-") == adapter.name if name else repo.imports(package))
        ]
        packages = [package for each in used if (package := HostRepo.installed(each))]
        for candidate in (above, *packages):
            with contextlib.suppress(UnknownHostError):
                return candidate, choose(candidate, adapters, name, select)
        raise


def choose(
    repo: HostRepo,
    adapters: Sequence[HostAdapter],
    name: str | None = None,
    select: Callable[..., str | None] | None = None,
) -> HostAdapter:
    """The adapter for a checkout: the one asked for, or the only one that fits.

    Args:
        repo: the checkout.
        adapters: to choose from.
        name: of the one asked for.
        select: breaks a tie; the hook ``fragprune_select_adapter``.

    Raises:
        UnknownHostError: none fits, the one asked for does not, or several do.
    """
    by_name = {adapter.name: adapter for adapter in adapters}
    if name is not None and name.replace("_", "-") not in by_name:
        raise UnknownHostError(
            "--adapter", repr(name), f"one of {', '.join(sorted(by_name)) or 'none'}", "Choose one."
        )
    wanted = [by_name[name.replace("_", "-")]] if name else list(adapters)
    matches = [(adapter, adapter.match(repo)) for adapter in wanted]
    fitting = [adapter for adapter, match in matches if match.fits]
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        reasons = "; ".join(
            f"{adapter.name}: {next((str(f) for f in match.findings if f.level == 'error'), '')}"
            for adapter, match in matches
        )
        raise UnknownHostError(
            str(repo.root),
            f"no adapter fits ({reasons or 'none is installed'})",
            "a codebase that an installed adapter knows",
            "Run fragprune check on the folder to see every seam, or write an adapter.",
        )
    tied = [match for _, match in matches if match.fits]
    selected = select(repo=repo, matches=tied) if select else None
    for adapter in fitting:
        if adapter.name == selected:
            return adapter
    raise UnknownHostError(
        str(repo.root),
        f"several adapters fit: {', '.join(a.name for a in fitting)}",
        "one",
        "Name it with --adapter.",
    )
