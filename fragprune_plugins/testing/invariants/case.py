"""The argument of a check, and helpers that checks share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.errors import FragpruneError
from fragprune_plugins.hosts.adapter import HostAdapter
from fragprune_plugins.hosts.seams import Role, Seam
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.plugins.hookspecs import hookimpl
from fragprune_plugins.testing.fresh import NotApplicable
from fragprune_plugins.testing.host import Host, Running, packages_of
from fragprune_plugins.testing.plugin import NOT_APPLICABLE

COUNT = 16


@dataclass(frozen=True)
class Case:
    """An adapter and the host to test it on."""

    adapter: HostAdapter
    driver: Host
    root: Path  # of a miniature, of a checkout or of installed packages; it is only read
    examples: int = 10  # sequences of actions to try
    longest: int = 3  # length of the longest order of import, activation and deactivation to try

    @property
    def repo(self) -> HostRepo:
        """The host's source."""
        return self.source(self.root)

    @property
    def packages(self) -> tuple[str, ...]:
        """The host's packages, if ``root`` is the folder of all installed packages."""
        return packages_of(self.adapter, self.driver)

    def source(self, folder: Path) -> HostRepo:
        """A copy of the host's source, as a ``HostRepo``."""
        return HostRepo(folder, self.driver.package)

    @property
    def seams(self) -> tuple[Seam, ...]:
        """The seams of this revision of the host."""
        return self.adapter.seams_for(self.repo)

    def has(self, role: Role) -> bool:
        """Whether the adapter wraps anything for a role."""
        return any(seam.role is role for seam in self.seams)

    def expect(self, promise: str, *roles: Role) -> None:
        """Require seams for a promise; NotApplicable if the host states why it cannot keep it."""
        if promise in self.driver.lacks:
            raise NotApplicable(f"{NOT_APPLICABLE}{self.driver.lacks[promise]}")
        missing = [role.name for role in roles if not self.has(role)]
        where = f'{type(self.driver).__name__}.lacks["{promise}"]'
        require(not missing, f"no seam for {' and '.join(missing)}, and no reason in {where}")

    def options(self) -> dict[str, Any]:
        """Keyword arguments for ``running`` and ``joint``."""
        return {"adapter": self.adapter, "path": self.root, "driver": self.driver}


def require(condition: object, found: str) -> None:
    """Raise AssertionError with a message unless the condition holds."""
    if not condition:
        raise AssertionError(found)


def refused(kind: type[FragpruneError], use: Callable[[], Any], found: str) -> FragpruneError:
    """The error of this kind that a use raises; AssertionError with a message if it goes on."""
    try:
        use()
    except kind as error:
        return error
    raise AssertionError(found)


class FixedThresholds:
    """A plugin that answers with fixed thresholds, and records what is drawn."""

    def __init__(self, values: Tensor | None = None) -> None:
        self.values, self.inputs, self.calls = values, None, 0
        self.asking: set[str] = set()  # fields of the Gaussians that required a gradient

    @hookimpl(tryfirst=True)
    def fragprune_truncate(self, inputs: Any, store: Any) -> Tensor | None:
        """The fixed thresholds; None for the learned ones."""
        self.inputs = inputs
        drawn = vars(inputs.splats)
        self.asking = {name for name, t in drawn.items() if torch.is_tensor(t) and t.requires_grad}
        self.calls += 1
        return self.values

    def counted(self, host: Running, thresholds: Tensor) -> Any:
        """``RasterOutputs`` of what was drawn last, with counts and these thresholds."""
        assert self.inputs is not None
        engine = host.engine(thresholds.device)
        with torch.no_grad():
            return engine.rasterize(replace(self.inputs, counts=True), thresholds)


def open_all(host: Running, model: Any) -> Any:
    """Set unequal thresholds between 0.02 and 0.4; returns the store."""
    store = host.store(model)
    with torch.no_grad():
        store.logits.copy_(torch.logit(torch.linspace(0.02, 0.4, len(store))))
    return store
