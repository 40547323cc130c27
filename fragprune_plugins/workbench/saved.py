"""Which models a codebase saves, as plugins read its source."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fragprune_plugins.hosts.findings import Plain
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.loading import Plugins, Wrong


def models_of(repo: HostRepo, plugins: Plugins) -> Sequence[Plain]:
    """The models that a codebase saves as PLYs, its own first; one without a name if none is."""

    def wrong(answer: Any) -> Wrong | None:
        fits = isinstance(answer, list | tuple) and all(isinstance(p, Plain) for p in answer)
        return None if answer and fits else (repr(answer), "a list of at least one Plain")

    found = plugins.ask(hookspecs.fragprune_read_models, wrong, repo=repo)
    return found or [Plain(("no plugin reads what it saves",))]
