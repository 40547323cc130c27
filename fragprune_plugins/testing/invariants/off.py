"""Invariant 1: while fragprune is installed but inactive, every object of the host is its own."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from importlib import import_module
from itertools import pairwise, product
from typing import Any
from unittest import mock

import torch
import wrapt

from fragprune_plugins.errors import LateImportError, SessionError
from fragprune_plugins.hosts.seams import Role, Seam
from fragprune_plugins.injection import session as sessions
from fragprune_plugins.injection.cpu_only import cpu_only
from fragprune_plugins.injection.session import Session
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.testing.host import imported, joint
from fragprune_plugins.testing.invariants.case import (
    COUNT,
    Case,
    FixedThresholds,
    open_all,
    require,
)


def orders(longest: int) -> list[str]:
    """All orders of events: I imports the host, A activates, D deactivates.

    One import, at most two activations, nothing twice in a row.
    """
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
        try:
            host.session.activate()
        except SessionError:
            pass
        else:
            raise AssertionError("a second activation was not refused")
        model = host.model(COUNT)
        open_all(host, model)
        with torch.no_grad():
            host.render(camera, model)
        require(fixed.calls == 2, "activated again, a picture asked for no thresholds")
