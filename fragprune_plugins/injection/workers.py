"""Prepares worker processes that a host spawns, for example its DataLoader's.

A spawned worker imports the host's script anew. Unprepared it would find no stand-ins, and draw
without thresholds. A forked worker needs nothing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from multiprocessing import spawn
from pathlib import Path
from typing import Any
from unittest import mock

from fragprune_plugins.errors import SessionError
from fragprune_plugins.hosts.seams import Role, Seam
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection import process
from fragprune_plugins.injection.session import Session
from fragprune_plugins.plugins.loading import installed

_kept = contextlib.ExitStack()


class _Preparation:
    """Unpickled in a worker, it prepares the worker; multiprocessing does so before all else."""

    def __init__(self, *words: Any) -> None:
        self._words = words

    def __reduce__(self) -> tuple[Callable[..., None], tuple[Any, ...]]:
        return _prepare, self._words


class _WorkerSession(Session):
    """The session of a worker: the host can be imported and used, and cannot draw."""

    def _enter(self, seam: Seam, function: Any, instance: Any, args: Any, kwargs: Any) -> Any:
        if seam.role is Role.RASTERIZE:
            expected = "drawing in the process that trains, which has the thresholds"
            remedy = "Start workers by fork, or draw in the main process."
            raise SessionError(str(seam), "a spawned worker process that draws", expected, remedy)
        return function(*args, **kwargs)


@contextlib.contextmanager
def prepared(session: Session, device: str) -> Iterator[None]:
    """Inside, worker processes that the host spawns are prepared for the session's host."""
    original = spawn.get_preparation_data
    repo = session.repo
    ours = _Preparation(session.adapter.name, repo.root, repo.package, device)

    def with_ours(name: str) -> dict[str, Any]:
        return {"fragprune": ours, **original(name)}

    with mock.patch.object(spawn, "get_preparation_data", with_ours):
        yield


def _prepare(adapter: str, root: Path, package: str, device: str) -> None:
    """Prepare this process, a worker; it stays so to its end."""
    plugins = installed()
    chosen = next(each for each in plugins.adapters if each.name == adapter)
    drop_in = True if device == "cpu" else None
    repo = HostRepo(root, package)
    _kept.enter_context(_WorkerSession(chosen, repo, plugins, learn=False, drop_in=drop_in))
    _kept.enter_context(process.surroundings(device))
