"""Proves rasterizers of these hosts; what draws and compares is in ``proof``, which loads torch."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from fragprune_graphdeco.kernels import vendored
from fragprune_plugins.adapting import Dialect, HostCall, HostRepo, Place, Proof, Prover, SeamCall


@dataclass(frozen=True)
class RasterizerProver(Prover):
    """Compares any rasterizer that takes the calls of a dialect of this family.

    Attributes:
        dialect: answers them.
        package: import name of the rasterizer.
        otherwise: how it is known to draw otherwise.
    """

    dialect: Dialect
    package: str
    otherwise: str

    def unproved(self, repo: HostRepo) -> str:
        """The sources of the rasterizer, if they are not vendored."""
        if vendored(repo, self.package):
            return ""
        return f"its picture; the sources of {self.package} are not in the checkout"

    def shape(self, call: HostCall) -> Iterable[Any]:
        """Which arguments a call has, and every rule that it sets."""
        from fragprune_graphdeco import proof

        return proof.shape(call)

    def prove(self, call: SeamCall, drawn: HostCall, place: Place) -> Proof:
        """Compare every output and every gradient."""
        from fragprune_graphdeco import proof

        return proof.prove(self.dialect, call, drawn, place)

    def answer(self, *args: Any, **kwargs: Any) -> Any:
        """Answer by the dialect, and by what the proof found beyond it."""
        from fragprune_graphdeco import proof

        return proof.answer(self.dialect, *args, **kwargs)
