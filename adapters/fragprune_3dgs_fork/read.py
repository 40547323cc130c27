"""Reads a fork of the 3DGS training code: its scripts, methods, draws, values and rows."""

from __future__ import annotations

from functools import lru_cache

from fragprune_3dgs_fork.draws import read_draws, read_outputs
from fragprune_3dgs_fork.fork import Fork
from fragprune_3dgs_fork.methods import read_changes, read_methods
from fragprune_3dgs_fork.scripts import read_scripts
from fragprune_graphdeco import reading
from fragprune_plugins.adapting import HostRepo


@lru_cache(maxsize=16)
def read_fork(repo: HostRepo) -> Fork:
    """Read a checkout, once; of several scripts only those that can be served, if one can."""
    fork = _read(repo, reading.training_scripts(repo, *reading.SCRIPTS, "*/*train*.py"))
    if fork.errors and len(fork.scripts) > 1:
        alone = {script: _read(repo, (script,)) for script in fork.scripts}
        refused = {name: each.errors[0].found for name, each in alone.items() if each.errors}
        if served := tuple(script for script in alone if script not in refused):
            unserved, fork = fork.unserved | refused, _read(repo, served)
            fork.unserved = unserved
    for script, why in fork.unserved.items() if fork.scripts else ():
        fork.warn("script", script, f"{script}, which is not served: {why}")
    return fork


def _read(repo: HostRepo, scripts: tuple[str, ...]) -> Fork:
    fork = Fork(repo)
    read_scripts(fork, scripts)
    if fork.scripts:
        read_methods(fork)
        read_draws(fork)
        read_outputs(fork)
        read_changes(fork)
    return fork
