"""Invariants 1 and 7: off is off, and a changed host is refused."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable
from functools import partial
from importlib import import_module
from itertools import pairwise, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import torch
import wrapt

from fragprune_plugins.errors import FragpruneError, LateImportError, SeamError, SessionError
from fragprune_plugins.hosts.choosing import choose
from fragprune_plugins.hosts.seams import Role, Seam
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection import session as sessions
from fragprune_plugins.injection.cpu_only import cpu_only
from fragprune_plugins.injection.session import Session
from fragprune_plugins.plugins.hooks import select_adapter
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.testing import mutations
from fragprune_plugins.testing.host import imported, joint, running
from fragprune_plugins.testing.invariants.case import (
    COUNT,
    Case,
    FixedThresholds,
    open_all,
    refused,
    require,
)


def orders(longest: int) -> list[str]:
    """All orders of I, one import, and of A and D, (de)activations: A twice at most, no repeats."""
    return [
        "".join(order)
        for length in range(1, longest + 1)
        for order in product("IAD", repeat=length)
        if order.count("I") == 1
        and order.count("A") <= 2
        and all(one != other for one, other in pairwise(order))
    ]


def off_is_off(case: Case, order: str) -> None:
    """In this order of events, every object of the host is its own whenever we are inactive."""
    dialect = case.adapter.dialect(case.repo)
    compiled = dialect.modules(_never_drawn)
    untold = compiled.keys() - dialect.names()
    require(not untold, f"names() leaves out {', '.join(sorted(untold))}, which modules() makes")
    sys.modules.update(compiled)  # as a host's own compiled packages, which outlast us
    originals: dict[Seam, Any] = {}
    session = Session(case.adapter, case.repo, load_plugins(), drop_in=False)
    with imported(case.root, case.packages), cpu_only():
        for number, event in enumerate(order):
            where = f"{order} after {order[: number + 1]}"
            active = sessions.active_session() is session
            if event == "I":
                originals = {seam: _pure(seam, active) for seam in _imported(case.seams)}
            elif event == "A" and not active:
                _activate(session, originals)
            elif event == "D":
                findings = session.deactivate()  # harmless when inactive
                require(not findings, f"{where}: {[str(f) for f in findings]}")
            active = sessions.active_session() is session
            for seam, original in originals.items():
                ours = _found(seam) is not original
                require(ours == active, f"{where}: {seam} is {'ours' if ours else 'its own'}")


def _imported(seams: Iterable[Seam]) -> list[Seam]:
    """Import the seams' modules; a metric's module may need a package that is not installed."""
    found = []
    for seam in seams:
        try:
            import_module(seam.module)
        except ModuleNotFoundError:
            if seam.role is not Role.METRIC:
                raise
        else:
            found.append(seam)
    return found


def _activate(session: Session, originals: dict[Seam, Any]) -> bool:
    """Activate; False if refused because a module already holds a seam's function."""
    try:
        session.activate()
    except LateImportError as error:
        modules = [sys.modules[seam.module] for seam in originals if not seam.external]
        held = any(
            vars(module).get(seam.attribute) is original
            for seam, original in originals.items()
            for module in modules
            if module is not sys.modules[seam.module]
        )
        require(held, f"refused without cause: {error}")
        return False
    return True


def _never_drawn(call: Any) -> Any:
    raise AssertionError("the host drew while only its modules were imported")


def _found(seam: Seam) -> Any:
    """The object at a seam, as its module or class holds it."""
    value: Any = sys.modules[seam.module]
    for name in seam.attribute.split("."):
        value = vars(value)[name] if isinstance(value, type) else getattr(value, name)
    return value


def _pure(seam: Seam, active: bool) -> Any:
    """The host's own object at a seam, below every wrapper of ours."""
    value = _found(seam)
    while active and isinstance(value, wrapt.FunctionWrapper):
        value = value.__wrapped__
    return value


def _wrapped_names(case: Case) -> list[str]:
    """The names in the host's modules that refer to wrapped functions."""
    inside = f"{case.repo.root}{os.sep}"
    modules = [
        module
        for module in list(sys.modules.values())
        if str(getattr(module, "__file__", "")).startswith(inside)
        and (not case.packages or module.__name__.split(".")[0] in case.packages)
    ]
    return [
        f"{module.__name__}.{name}"
        for module in modules
        for name, value in vars(module).items()
        if isinstance(value, wrapt.FunctionWrapper)
    ]


def nothing_stays(case: Case) -> None:
    """After a session with learned thresholds the host draws and computes as it does alone."""
    names = list(case.adapter.dialect(case.repo).modules(_never_drawn))
    fixed = FixedThresholds()
    with joint(plugins=[fixed], **case.options()) as host:
        inside = _imported(seam for seam in case.seams if not seam.external)
        originals = {seam: _pure(seam, True) for seam in inside}
        model, camera = host.model(COUNT), host.camera()
        open_all(host, model)
        with torch.no_grad():
            truncated = host.render(camera, model)["render"]
            require(fixed.calls == 1, f"one picture asked {fixed.calls} times for thresholds")
            with host.paused():
                alone = host.render(camera, model)["render"]
        require(not torch.equal(truncated, alone), "paused, thresholds were still applied")
        rasterizers = {name: sys.modules[name] for name in names}
        findings = [str(finding) for finding in host.deactivate()]
        require(not findings, f"something could not be restored: {findings}")
        kept = [str(seam) for seam, original in originals.items() if _found(seam) is not original]
        require(not kept, f"not the host's own after the session: {kept}")
        held = _wrapped_names(case)
        require(not held, f"ours by name after the session: {held}")
        require(not host.deactivate(), "deactivating twice is not harmless")
        left = [name for name in names if name in sys.modules]
        require(not left, f"stand-ins left in sys.modules: {left}")
        again = sessions.active_session()
        require(again is None, "a session is still active")
        if host.driver.draws_alone:
            with torch.no_grad(), mock.patch.dict(sys.modules, rasterizers):  # imported to draw
                own = host.render(camera, model)["render"]
            require(torch.equal(own, alone), "deactivated, the host's picture is not its own")
        if not _activate(host.session, originals):
            return
        refused(SessionError, host.session.activate, "a second activation was not refused")
        model = host.model(COUNT)
        open_all(host, model)
        with torch.no_grad():
            host.render(camera, model)
        require(fixed.calls == 2, "activated again, a picture asked for no thresholds")


def refuse(case: Case) -> None:
    """A host with one change is refused by the name of that change, and nothing stays patched."""
    require(case.adapter.match(case.repo).fits, "the adapter does not fit the host it is for")
    _is_chosen(case)
    with TemporaryDirectory() as folder:
        copy = mutations.copy_source(case.repo, Path(folder), case.packages)
        for seam in dict.fromkeys(seam for seam in case.seams if not seam.external):
            with mutations.changing(copy, seam):
                mutations.rename_function(copy, seam)
                _expect_refusal(case, case.source(copy.root), seam)
            with mutations.changing(copy, seam):
                for name in seam.needs:
                    mutations.rename_parameter(case.source(copy.root), seam, name)
                if seam.needs:
                    _expect_refusal(case, case.source(copy.root), seam, *seam.needs)
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


def _expect_refusal(case: Case, repo: HostRepo, seam: Seam, *names: str) -> None:
    match = case.adapter.match(repo)
    what = f"{seam} {f'without parameters {names}' if names else 'renamed'}"
    require(not match.fits, f"{what}: still taken for the host")
    errors = [finding for finding in match.findings if finding.level == "error"]
    code = "seam-signature" if names else "seam-missing"
    told = [f.expected for f in errors if f.code == code and f.where.startswith(str(seam))]
    said = any({*names} <= {*re.findall(r"\w+", each)} for each in told)
    require(said, f"{what}: not named; said {[str(error) for error in errors]}")


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
        load = partial(import_module, seam.module)
        error = refused(FragpruneError, load, f"{seam} was imported without {seam.needs[0]}")
        require(isinstance(error, SeamError), f"refused for another reason: {error}")
        require(seam.needs[0] in error.expected, f"another parameter is named: {error}")
        require(seam.module not in sys.modules, f"{seam.module} is half imported")
        require(not host.deactivate(), "something could not be restored")
        require(sessions.active_session() is None, "a session is still active")
