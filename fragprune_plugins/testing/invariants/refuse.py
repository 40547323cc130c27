"""Invariant 7: a changed host is refused by what changed."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

from fragprune_plugins.errors import FragpruneError, SeamError
from fragprune_plugins.hosts.seams import Role, Seam
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection import session as sessions
from fragprune_plugins.testing import mutations
from fragprune_plugins.testing.host import running
from fragprune_plugins.testing.invariants.case import Case, require


def refuse(case: Case) -> str:
    """A host with one thing changed is refused by that thing's name, and nothing stays patched."""
    require(case.adapter.match(case.repo).fits, "the adapter does not fit the host it is for")
    changes = 0
    for seam in dict.fromkeys(seam for seam in case.seams if not seam.external):
        for name in (None, *seam.needs):
            with TemporaryDirectory() as folder:
                repo = mutations.copy_source(case.root, Path(folder))
                if name is None:
                    mutations.rename_function(repo, seam)
                else:
                    mutations.rename_parameter(repo, seam, name)
                _expect_refusal(case, HostRepo(Path(folder)), seam, name)
                changes += 1
    for seam in (seam for seam in case.seams if seam.role is Role.VIEW):
        with TemporaryDirectory() as folder:
            repo = mutations.copy_source(case.root, Path(folder))
            line = mutations.unpack_one_more(repo, seam)
            if line is not None:
                _expect_place(case, HostRepo(Path(folder)), seam, line)
                changes += 1
    with TemporaryDirectory() as folder:
        match = case.adapter.match(HostRepo(Path(folder)))
        require(not match.fits, "an empty folder is taken for the host")
    _import_is_refused(case)
    return f"{changes} changed sources"


def _expect_refusal(case: Case, repo: HostRepo, seam: Seam, name: str | None) -> None:
    match = case.adapter.match(repo)
    what = f"{seam} {'renamed' if name is None else f'without parameter {name}'}"
    require(not match.fits, f"{what}: still taken for the host")
    errors = [finding for finding in match.findings if finding.level == "error"]
    code = "seam-missing" if name is None else "seam-signature"
    named = [f for f in errors if f.code == code and f.where.startswith(str(seam))]
    require(named, f"{what}: not named; said {[str(error) for error in errors]}")


def _expect_place(case: Case, repo: HostRepo, seam: Seam, line: int) -> None:
    """Another number of values from the rasterizer is refused, and the line is said."""
    errors = [f for f in case.adapter.match(repo).findings if f.level == "error"]
    at = f"{seam} ({repo.at(seam.module, line)})"
    what = f"{seam} takes one value more from its rasterizer in line {line}"
    require(any(f.where == at for f in errors), f"{what}: said {[str(error) for error in errors]}")


def _import_is_refused(case: Case) -> None:
    """Where detection was skipped, the host's own import fails, and the session leaves no trace."""
    seam = next(seam for seam in case.seams if seam.needs and not seam.external)
    with TemporaryDirectory() as folder:
        repo = mutations.copy_source(case.root, Path(folder))
        mutations.rename_parameter(repo, seam, seam.needs[0])
        with running(**{**case.options(), "path": Path(folder)}, active=False) as host:
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
