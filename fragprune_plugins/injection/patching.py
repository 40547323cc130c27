"""The patch ledger wraps seams when their modules are imported, and restores them.

wrapt wraps and unwraps. The ledger also checks signatures and refuses a host that was imported too
early. A wrapper that cannot be removed is reported; it stays, and only calls the original.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import wrapt

from fragprune_plugins.errors import LateImportError, SeamError
from fragprune_plugins.hosts.findings import Finding
from fragprune_plugins.hosts.seams import Seam

_CHECK = "Run fragprune check on the host to see which adapter fits."

Wrapper = Callable[[Callable[..., Any], Any, tuple[Any, ...], dict[str, Any]], Any]


class PatchLedger:
    """Keeps the wrapped seams in order and restores them.

    Args:
        root: the host's folder, from which its modules must come; None for any folder.
        packages: import names of the host's packages, if its folder holds other packages too.
    """

    def __init__(self, root: Path | None = None, packages: tuple[str, ...] = ()) -> None:
        self._root, self._packages = root, packages
        self._live = True
        self._wrapped: list[tuple[ModuleType, Seam, Any]] = []
        self._waiting: list[list[Callable[[ModuleType], None]]] = []

    def wrap(self, seam: Seam, wrapper: Wrapper) -> None:
        """Wrap a seam now, or as soon as its module is imported, by ``wrapper`` as wrapt calls it.

        Raises:
            LateImportError: the module is imported, and other modules hold the function by name.
            SeamError: the function is missing or lacks a parameter. A later import may raise it.
        """

        def standing_aside(wrapped: Any, instance: Any, args: Any, kwargs: Any) -> Any:
            if not self._live:
                return wrapped(*args, **kwargs)
            return wrapper(wrapped, instance, args, kwargs)

        def apply(module: ModuleType) -> None:
            if self._live:
                self._check(module, seam)
                handle = wrapt.wrap_function_wrapper(module, seam.attribute, standing_aside)
                self._wrapped.append((module, seam, handle))

        module = sys.modules.get(seam.module)
        if module is not None:
            self._refuse_late(module, seam)
            apply(module)
            return
        # wrapt keeps a hook whose module is never imported: undo() empties it.
        waiting: list[Callable[[ModuleType], None]] = [apply]
        self._waiting.append(waiting)
        wrapt.register_post_import_hook(lambda found: [do(found) for do in waiting], seam.module)

    def undo(self) -> list[Finding]:
        """Restore every original, newest first; gives a finding for each wrapper that stays."""
        self._live = False
        for waiting in self._waiting:
            waiting.clear()
        findings = []
        while self._wrapped:
            module, seam, handle = self._wrapped.pop()
            try:
                wrapt.unwrap_object(module, seam.attribute, handle)
                # Copies by ``from module import name``.
                for other in _holding(seam.attribute, handle).values():
                    setattr(other, seam.attribute, getattr(module, seam.attribute))
            except (wrapt.WrapperNotOutermostError, wrapt.WrapperNotFoundError) as error:
                remedy = "The wrapper stays, and only calls the original."
                said = str(seam), str(error), "fragprune's wrapper outermost", remedy
                findings.append(Finding("warning", "not-undone", *said))
        return findings

    def _is_hosts(self, module: ModuleType) -> bool:
        if self._packages and module.__name__.split(".")[0] not in self._packages:
            return False
        file = getattr(module, "__file__", None)
        return not file or Path(file).resolve().is_relative_to(self._root or "/")

    def _check(self, module: ModuleType, seam: Seam) -> None:
        if not seam.external and not self._is_hosts(module):
            # Hosts' modules have common names, and some hosts append their folder to the path.
            found = f"a module of the same name from {module.__file__}"
            remedy = "Uninstall the other module, or remove it from PYTHONPATH."
            raise SeamError(str(seam), found, f"the host's module, in {self._root}", remedy)
        try:
            original = wrapt.resolve_path(module, seam.attribute)[2]
        except AttributeError as error:
            raise SeamError(str(seam), "no such function", "a function to wrap", _CHECK) from error
        have = tuple(inspect.signature(original).parameters)
        if missing := [name for name in seam.needs if name not in have]:
            found, expected = f"parameters ({', '.join(have)})", f"also {', '.join(missing)}"
            raise SeamError(str(seam), found, expected, _CHECK)

    def _refuse_late(self, module: ModuleType, seam: Seam) -> None:
        """Refuse if a module holds a copy by ``from module import name``, which stays unpatched.

        Of a function outside the host (``seam.external``) only the host's modules count.
        """
        name = seam.attribute
        original = getattr(module, name, None)
        if "." in name or original is None:
            return  # a method is patched on its class, which all modules share
        holders = [
            key
            for key, other in _holding(name, original).items()
            if other is not module and (not seam.external or self._is_hosts(other))
        ]
        if holders:
            found = f"already imported, and bound by name in {', '.join(sorted(holders))}"
            remedy = "Use fragprune run, or activate() above those imports (restart notebooks)."
            raise LateImportError(str(seam), found, "activation before the host's imports", remedy)


def _holding(name: str, thing: Any) -> dict[str, ModuleType]:
    """The modules that hold a thing by this name: none for a method, which its class holds."""
    loaded = [] if "." in name else list(sys.modules.items())
    return {key: each for key, each in loaded if getattr(each, "__dict__", {}).get(name) is thing}
