"""Activates fragprune in a fork: ``import fragprune_plugins; fragprune_plugins.activate()``."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Literal

from fragprune_plugins.hosts.choosing import locate
from fragprune_plugins.hosts.findings import Finding
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection import session as _session
from fragprune_plugins.injection.session import Session
from fragprune_plugins.learning.schedule import JointSchedule, Settings
from fragprune_plugins.plugins.hooks import select_adapter
from fragprune_plugins.plugins.loading import installed


def activate(
    adapter: str | None = None,
    *,
    host: str | Path | None = None,
    stage: Literal["finetune", "joint", "off"] = "finetune",
    from_iter: int = 0,
    settings: Settings | None = None,
    engine: str = "auto",
) -> Session:
    """Inject thresholds into the host of this process. Call it above the host's imports.

    Args:
        adapter: the adapter's name; None detects it from the host's source.
        host: the checkout's folder; None for the running script's, or a shell's current one.
        stage: "finetune" trains thresholds and what ``settings.train`` names, "joint"
            trains everything, "off" only applies thresholds of sidecars.
        from_iter: number of iterations of this run before learning begins (0 if it is resumed).
        settings: settings of the fine-tuning; ``iterations`` is its length.
        engine: "auto", "reference", "cpu", "cuda" or the name of a plugin's engine.

    Raises:
        UnknownHostError: no adapter fits.
        LateImportError: the host is already imported.
        SessionError: a session is already active.
    """
    settings, plugins = settings or Settings(), installed()
    joint = stage == "joint"
    shell = hasattr(sys, "ps1") and not hasattr(sys.modules["__main__"], "__file__")
    begun = "-" if shell else sys.argv[0] or "-"
    folder = Path(host) if host is not None else Path(begun).resolve().parent
    tie = partial(select_adapter, plugins=plugins)
    repo, chosen = locate(HostRepo(folder), plugins.adapters, adapter, select=tie)
    return Session(
        chosen,
        repo,
        plugins,
        settings,
        learn=stage != "off",
        schedule=JointSchedule(settings, from_iter + 1) if joint else None,
        from_step=0 if joint else from_iter,
        freeze=not joint,
        engine=engine,
    ).activate()


def deactivate() -> list[Finding]:
    """Restore every original of the host; gives a finding for each that cannot be restored."""
    active = _session.active_session()
    return active.deactivate() if active else []


@contextlib.contextmanager
def paused() -> Iterator[None]:
    """Inside, the host draws without thresholds; fragprune still follows rows."""
    active = _session.active_session()
    with active.paused() if active else contextlib.nullcontext():
        yield
