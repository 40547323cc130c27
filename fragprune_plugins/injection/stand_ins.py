"""Places stand-ins for a host's compiled packages in ``sys.modules``."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from fragprune_plugins.errors import LateImportError, log
from fragprune_plugins.hosts.dialect import Dialect, HostCall
from fragprune_plugins.hosts.preflight import present


def runs_here(dialect: Dialect, package: str) -> bool:
    """Whether the host can import and run its own compiled modules of a package here."""
    names = dialect.names()
    own = package not in names and any(name.startswith(f"{package}.") for name in names)
    if not (own and dialect.own_kernels):
        return present(package)
    # Nothing is imported: the host's folder need not be on the path yet.
    if dialect.own_kernels == "compiler" and torch.cuda.is_available():
        from torch.utils.cpp_extension import CUDA_HOME  # brings setuptools, which alters sys.path

        return CUDA_HOME is not None
    return torch.cuda.is_available()


class StandIns:
    """The stand-ins that a dialect makes for its host's compiled packages.

    Args:
        draw: answers the host's rasterizer calls.
        drop_in: whether to place stand-ins; None places those whose packages cannot be imported.
    """

    def __init__(
        self, dialect: Dialect, draw: Callable[[HostCall], Any], drop_in: bool | None
    ) -> None:
        self._dialect, self._draw, self._drop_in = dialect, draw, drop_in
        self._made: dict[str, ModuleType] = {}  # made once, because a host keeps its imports
        self._placed: dict[str, ModuleType] = {}

    def place(self) -> None:
        """Put the stand-ins into ``sys.modules``."""
        self._made = self._made or self._dialect.modules(self._draw)
        for name, module in self._made.items():
            package = name.split(".")[0]
            wanted = self._drop_in
            if wanted is None:
                wanted = package in self._placed or not runs_here(self._dialect, package)
            if not wanted:
                continue
            if name in sys.modules:
                expected = "activation before the host imports its rasterizer"
                remedy = "Start the host with fragprune run, or call activate() above its imports."
                raise LateImportError(name, "already imported", expected, remedy)
            sys.modules[name] = self._placed[name] = module
        for name, members in self._dialect.unneeded.items() if self._drop_in else ():
            if name not in sys.modules and find_spec(name) is None:
                log.warning("%s is not installed: the host imports an empty stand-in", name)
                module = ModuleType(name, "Stand-in of fragprune: empty.")
                vars(module).update(members)
                sys.modules[name] = self._placed[name] = module

    def answers(self, module: str) -> bool:
        """Whether a stand-in is in a module's place."""
        return module in self._placed

    def take_back(self) -> None:
        """Remove the stand-ins from ``sys.modules``."""
        for name, module in self._placed.items():
            if sys.modules.get(name) is module:
                del sys.modules[name]
        self._placed.clear()

    def refuse_leftovers(self, root: Path) -> None:
        """Refuse a host that was imported in an earlier session and draws with its classes."""
        inside = f"{root}{os.sep}"
        loaded = list(sys.modules.values())
        hosts = [each for each in loaded if str(getattr(each, "__file__", "")).startswith(inside)]
        for name, stand_in in self._placed.items():
            for member, ours in vars(stand_in).items():
                maker = getattr(ours, "__module__", None)
                for module in hosts:
                    held = vars(module).get(member, ours)
                    if held is not ours and maker and getattr(held, "__module__", None) == maker:
                        found = f"bound in {module.__name__} since an earlier session"
                        expected = "a host that is imported in this session"
                        remedy = "Activate the earlier session again, or start a new process."
                        raise LateImportError(f"{name}.{member}", found, expected, remedy)
