"""The base of adapters whose hosts' forks may change the model in further ways."""

from __future__ import annotations

from functools import lru_cache
from typing import ClassVar

from fragprune_3dgs_fork.fork import Fork
from fragprune_3dgs_fork.methods import STATISTICS, read_changes, read_methods
from fragprune_graphdeco import GraphdecoAdapter, model_seam
from fragprune_plugins.adapting import Finding, HostRepo, Role, Seam


class HoldingAdapter(GraphdecoAdapter):
    """Holds still, in stage 2, what scripts change besides what its host does.

    Attributes:
        kept: methods that change the model, of the host itself, and that stage 2 may call.
    """

    kept: ClassVar[tuple[str, ...]] = ()

    def _changes(self, repo: HostRepo) -> Fork:
        scripts = (each for each in self.scripts_of(repo) if (repo.root / each).is_file())
        return _changes(repo, tuple(scripts))

    def seams_for(self, repo: HostRepo) -> tuple[Seam, ...]:
        """Also at further methods that change the model, and that scripts call."""
        seams = super().seams_for(repo)
        known = {each.attribute.rpartition(".")[2] for each in seams} | STATISTICS | {*self.kept}
        further = (each for each in self._changes(repo).still if each not in known)
        return (*seams, *(model_seam(Role.STILL, each) for each in further))

    def options(self, repo: HostRepo) -> frozenset[str]:
        """Also those under which scripts change the model themselves."""
        return super().options(repo) | self._changes(repo).options

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """Also an error where scripts change the model themselves."""
        return super().fingerprint(repo) + self._changes(repo).errors


@lru_cache(maxsize=16)
def _changes(repo: HostRepo, scripts: tuple[str, ...]) -> Fork:
    """What scripts of a checkout change of its model."""
    fork = Fork(repo, scripts=scripts)
    read_methods(fork)
    read_changes(fork)
    return fork
