"""One line in a fork: ``import fragprune_plugins; fragprune_plugins.activate()``."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Literal

from fragprune_plugins.hosts.choosing import locate
from fragprune_plugins.hosts.findings import Finding
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
    """Inject thresholds into the host of this process; call it above the host's imports.

    Args:
        adapter: name; None detects it from the source.
        host: the checkout's folder; None takes that of the running script.
        stage: "finetune" freezes everything but opacities and thresholds, "joint" trains all,
            "off" only applies thresholds that sidecars bring.
        from_iter: iterations of this run to let pass first (0 when it was resumed).
        settings: of the fine-tuning; ``iterations`` is how long it lasts.
        engine: "auto", "reference", "cpu", "cuda" or the name of a plugin's.

    Raises:
        UnknownHostError: no adapter fits.
        LateImportError: the host was imported before.
        SessionError: a session is active already.
    """
    settings = settings or Settings()
    plugins = installed()
    joint = stage == "joint"
    folder = Path(host) if host is not None else Path(sys.argv[0]).resolve().parent
    tie = partial(select_adapter, plugins=plugins)
    repo, chosen = locate(folder, plugins.adapters, adapter, select=tie)
    return Session(
        chosen,
        repo,
        plugins,
        settings,
        learn=stage != "off",
        schedule=JointSchedule(settings, from_iter) if joint else None,
        from_step=0 if joint else from_iter,
        freeze=not joint,
        engine=engine,
    ).activate()


def deactivate() -> list[Finding]:
    """Restore every original of the host; returns what could not be. Harmless when inactive."""
    active = _session.active_session()
    return active.deactivate() if active else []


@contextlib.contextmanager
def paused() -> Iterator[None]:
    """Inside, the host draws as if fragprune were not active; rows are still followed."""
    active = _session.active_session()
    with active.paused() if active else contextlib.nullcontext():
        yield
