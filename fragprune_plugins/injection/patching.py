"""The patch ledger: seams wrapped when their module is imported, undone faithfully.

wrapt does the wrapping and the way back; the ledger adds what hosts need: the signature is checked
before anything runs, a host that was imported too early is refused by name, and whatever cannot be
taken back is reported and turned inert.
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

Wrapper = Callable[[Callable[..., Any], Any, tuple[Any, ...], dict[str, Any]], Any]


class PatchLedger:
    """What we wrapped, in order, and how to take it back.

    Args:
        root: the host's folder; its modules must come from there. None: from anywhere.
    """

    def __init__(self, root: Path | None = None) -> None:
        self._root = root
        self._live = True
        self._wrapped: list[tuple[ModuleType, Seam, Any]] = []

    def wrap(self, seam: Seam, wrapper: Wrapper) -> None:
        """Wrap a seam now if its module is imported, else the moment it is.

        Args:
            seam: where.
            wrapper: ``wrapper(wrapped, instance, args, kwargs)``, wrapt's convention.

        Raises:
            LateImportError: the module is imported and others hold the function by name.
            SeamError: the function is missing or lacks a parameter. When the module is imported
                later, the host's ``import`` raises it.
        """

        def standing_aside(
            wrapped: Callable[..., Any],
            instance: Any,
            args: tuple[Any, ...],
            kwargs: dict[str, Any],
        ) -> Any:
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
        else:
            wrapt.register_post_import_hook(apply, seam.module)

    def undo(self) -> list[Finding]:
        """Restore every original, newest first; findings name what could not be taken back."""
        self._live = False
        findings = []
        while self._wrapped:
            module, seam, handle = self._wrapped.pop()
            try:
                wrapt.unwrap_object(module, seam.attribute, handle)
                if "." not in seam.attribute:  # a method is held by its class alone
                    _rebind(seam.attribute, handle, module)
            except (wrapt.WrapperNotOutermostError, wrapt.WrapperNotFoundError) as error:
                findings.append(
                    Finding(
                        "warning",
                        "not-undone",
                        str(seam),
                        str(error),
                        "our wrapper outermost",
                        "fragprune stays in the chain, inactive.",
                    )
                )
        return findings

    def _is_hosts(self, module: ModuleType) -> bool:
        file = getattr(module, "__file__", None)
        return not file or Path(file).resolve().is_relative_to(self._root or "/")

    def _check(self, module: ModuleType, seam: Seam) -> None:
        if not seam.external and not self._is_hosts(module):
            # Hosts have plain names, and some append themselves to the path.
            raise SeamError(
                str(seam),
                f"a module of the same name from {module.__file__}",
                f"the host's, in {self._root}",
                "Uninstall the other, or take it from PYTHONPATH.",
            )
        try:
            original = wrapt.resolve_path(module, seam.attribute)[2]
        except AttributeError as error:
            raise SeamError(
                str(seam),
                "no such function",
                "one to wrap",
                "Run fragprune check on the host to see which adapter fits.",
            ) from error
        have = tuple(inspect.signature(original).parameters)
        if missing := [name for name in seam.needs if name not in have]:
            raise SeamError(
                str(seam),
                f"parameters ({', '.join(have)})",
                f"also {', '.join(missing)}",
                "Run fragprune check on the host to see which adapter fits.",
            )

    def _refuse_late(self, module: ModuleType, seam: Seam) -> None:
        """A copy bound by ``from module import name`` would stay unpatched: refuse, name it.

        Of a function that is not the host's, only the host's copies matter.
        """
        head = seam.attribute.split(".")[0]
        if head != seam.attribute:
            return  # a method is patched on its class, which every holder shares
        original = getattr(module, head, None)
        holders = [
            name
            for name, other in list(sys.modules.items())
            if other is not module
            and (not seam.external or self._is_hosts(other))
            and original is not None
            and getattr(other, "__dict__", {}).get(head) is original
        ]
        if holders:
            raise LateImportError(
                str(seam),
                f"already imported, and bound by name in {', '.join(sorted(holders))}",
                "activation before the host's imports",
                "Start the host with fragprune run, or call activate() above those imports.",
            )


def _rebind(name: str, ours: Any, module: ModuleType) -> None:
    """Copies that others made by ``from module import name`` become what the module has again."""
    for other in list(sys.modules.values()):
        if getattr(other, "__dict__", {}).get(name) is ours:
            setattr(other, name, getattr(module, name))
