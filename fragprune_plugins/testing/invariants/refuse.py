"""Invariant 7: a changed host is refused, and the error names the change."""

from __future__ import annotations

import sys
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

from fragprune_plugins.errors import FragpruneError, SeamError
from fragprune_plugins.hosts.choosing import choose
from fragprune_plugins.hosts.seams import Role, Seam
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection import session as sessions
from fragprune_plugins.plugins.hooks import select_adapter
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.testing import mutations
from fragprune_plugins.testing.host import running
from fragprune_plugins.testing.invariants.case import Case, require


def refuse(case: Case) -> None:
    """A host with one change is refused by the name of that change, and nothing stays patched."""
    require(case.adapter.match(case.repo).fits, "the adapter does not fit the host it is for")
    _is_chosen(case)
    with TemporaryDirectory() as folder:
        copy = mutations.copy_source(case.repo, Path(folder), case.packages)
        for seam in dict.fromkeys(seam for seam in case.seams if not seam.external):
            for name in (None, *seam.needs):
                with mutations.changing(copy, seam):
                    if name is None:
                        mutations.rename_function(copy, seam)
                    else:
                        mutations.rename_parameter(copy, seam, name)
                    _expect_refusal(case, case.source(copy.root), seam, name)
        for seam in _callers(case):
            with mutations.changing(copy, seam):
                line = mutations.unpack_one_more(copy, seam)
                if line is not None:
                    _expect_place(case, case.source(copy.root), seam, line)
        _import_is_refused(case, copy)
    with TemporaryDirectory() as folder:
        match = case.adapter.match(case.source(Path(folder)))
        require(not match.fits, "an empty folder is taken for the host")


def _callers(case: Case) -> list[Seam]:
    """The host's functions that call its rasterizer, without the rasterizer itself."""
    drawn = {str(seam) for seam in case.seams if seam.role is Role.RASTERIZE}
    return [seam for seam in case.seams if seam.role is Role.VIEW and str(seam) not in drawn]


def _is_chosen(case: Case) -> None:
    """The adapter is chosen among all installed adapters."""
    plugins = load_plugins()
    adapters = {each.name: each for each in (*plugins.adapters, case.adapter)}
    tie = partial(select_adapter, plugins=plugins)
    chosen = choose(case.repo, list(adapters.values()), select=tie)
    require(chosen.name == case.adapter.name, f"{chosen.name} is chosen for the host")


def _expect_refusal(case: Case, repo: HostRepo, seam: Seam, name: str | None) -> None:
    match = case.adapter.match(repo)
    what = f"{seam} {'renamed' if name is None else f'without parameter {name}'}"
    require(not match.fits, f"{what}: still taken for the host")
    errors = [finding for finding in match.findings if finding.level == "error"]
    code = "seam-missing" if name is None else "seam-signature"
    named = [f for f in errors if f.code == code and f.where.startswith(str(seam))]
    require(named, f"{what}: not named; said {[str(error) for error in errors]}")


def _expect_place(case: Case, repo: HostRepo, seam: Seam, line: int) -> None:
    """If the rasterizer returns another number of values, the error names the line."""
    errors = [f for f in case.adapter.match(repo).findings if f.level == "error"]
    at = f"{seam} ({repo.at(seam.module, line)})"
    what = f"{seam} takes one value more from its rasterizer in line {line}"
    require(any(f.where == at for f in errors), f"{what}: said {[str(error) for error in errors]}")


def _import_is_refused(case: Case, copy: HostRepo) -> None:
    """If detection is skipped, the host's import fails, and the session leaves no trace."""
    seam = next(seam for seam in case.seams if seam.needs and not seam.external)
    mutations.rename_parameter(copy, seam, seam.needs[0])
    with running(**{**case.options(), "path": copy.root}, active=False) as host:
        host.session.activate()
        try:
            import_module(seam.module)
        except SeamError as error:
            require(seam.needs[0] in error.expected, f"another parameter is named: {error}")
        except FragpruneError as error:
            raise AssertionError(f"refused for another reason: {error}") from error
        else:
            raise AssertionError(f"{seam} was imported without {seam.needs[0]}")
        require(seam.module not in sys.modules, f"{seam.module} is half imported")
        require(not host.deactivate(), "something could not be restored")
        require(sessions.active_session() is None, "a session is still active")
