"""Tools to test an adapter: the conformance kit."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fragprune_plugins.testing.conformance import AdapterConformance
    from fragprune_plugins.testing.host import Chance, Host

__all__ = ["AdapterConformance", "Chance", "Host"]

_HOME = {"AdapterConformance": "conformance", "Chance": "host", "Host": "host"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = import_module(f"{__name__}.{_HOME[name]}")
    except ModuleNotFoundError as error:
        remedy = "The conformance kit needs pip install 'fragprune-plugins[test]'."
        raise ModuleNotFoundError(f"{error}. {remedy}", name=error.name) from error
    return getattr(module, name)
