"""Seams: the functions of a host that we wrap, as data.

Data can be printed, checked against the source without an import, tested in every order and undone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from inspect import Signature, signature
from typing import Any
from weakref import WeakKeyDictionary


class Role(Enum):
    """What the session does at a seam. The set is closed; the session defines each role.

    Attributes:
        does: what the session does, as text.
        how: what the seam's ``how`` returns for a call, and when it is called; "" if it is not.
    """

    SCENE = (
        "learn where the host writes its output",
        "after: nothing; it may note what it needs of a scene that was read",
    )
    ATTACH = "give the model its threshold store", "after: its optimizers, the main one first"
    STEP = (
        "count one training step",
        "in stage 2, after: the value to return to the host (the call's result)",
    )
    VIEW = (
        "remember which model is being rendered",
        "before: whether the view may begin a step, where views do (True)",
    )
    RASTERIZE = "draw with thresholds"
    LOSS = "note the host's loss when it goes backward"
    SIMILARITY = (
        "answer structural similarity on a CPU in compiled code, once a call made both ways agreed"
    )
    METRIC = "evaluate a picture; NaN if the weights cannot be loaded"
    ANSWER = (
        "answer a call that the host's own function cannot answer on this machine",
        "instead: the result",
    )
    KEEP = "keep the surviving rows"
    APPEND = "append rows, with the thresholds of those whose copies they are"
    REARRANGE = (
        "follow rows that one call keeps, overwrites, copies and appends; nothing in stage 2",
        "before and after: by name the tensors (N, ...) that tell rows apart (the param groups)",
    )
    STILL = (
        "do nothing in stage 2: for functions that would change frozen parameters or rows",
        "instead: the return value of the skipped call (None)",
    )
    SAVE = "write the sidecar beside the model's file", "after: the file (the path as passed)"
    LOAD = "read the sidecar beside the model's file", "after: the file (the path as passed)"
    PACK = (
        "write the sidecar of a file with the model's Gaussians in another order",
        "after: the file's path, and in its order its means (M, 3), bit for bit the model's, or "
        "the model's rows (M,) int64; None if the call was about something else",
    )
    UNPACK = (
        "read that sidecar for the model that will be made from the file",
        "after: as PACK, with means",
    )
    CAPTURE = "put thresholds into the host's checkpoint"
    RESTORE = (
        "take thresholds out of the host's checkpoint",
        "before: the checkpoint, completed if it lacks something (as passed)",
    )

    def __init__(self, does: str, how: str = "") -> None:
        self.does, self.how = does, how


NEEDS_HOW = frozenset({Role.ATTACH, Role.PACK, Role.UNPACK, Role.ANSWER})
"""Roles whose seams need a ``how`` from the adapter."""


@dataclass(frozen=True)
class Seam:
    """A function of a host, named by module and attribute.

    Attributes:
        role: what the session does there.
        module: dotted import name.
        attribute: dotted path inside it, such as "GaussianModel.training_setup".
        needs: parameter names that the function must have. The session reads arguments by these
            names, and uses the first one.
        external: the module is not part of the host's folder (a compiled package), so only the
            import can check it.
        how: a function for the host's own way of doing this; see the role.
    """

    role: Role
    module: str
    attribute: str
    needs: tuple[str, ...] = ()
    external: bool = False
    how: Callable[[SeamCall], Any] | None = None

    def __post_init__(self) -> None:
        if self.role in NEEDS_HOW and self.how is None:
            raise ValueError(f"{self}: a seam of role {self.role.name} says how")

    def __str__(self) -> str:
        return f"{self.module}:{self.attribute}"


_signatures: WeakKeyDictionary[Callable[..., Any], Signature] = WeakKeyDictionary()


@dataclass
class SeamCall:
    """A call of the host's function at a seam.

    Attributes:
        function: the host's own.
        instance: what the method was called on; None for a function.
        result: what the host's function returned; None until it was called.
    """

    seam: Seam
    function: Callable[..., Any]
    instance: Any
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    model: Any = None
    result: Any = None

    @cached_property
    def arguments(self) -> dict[str, Any]:
        """All arguments by name, with defaults for omitted ones."""
        bound = self._signature.bind(*self.args, **self.kwargs)
        bound.apply_defaults()
        return bound.arguments

    @property
    def _signature(self) -> Signature:
        """The function's, read once: a view is drawn in a few times as long as it takes."""
        plain = getattr(self.function, "__func__", self.function)
        try:
            found = _signatures.get(plain) or _signatures.setdefault(plain, signature(plain))
        except TypeError:  # functions of C take no weak reference
            return signature(self.function)
        if plain is self.function:
            return found
        return found.replace(parameters=[*found.parameters.values()][1:])  # a method's instance

    @property
    def first(self) -> Any:
        """The argument that ``needs`` names first."""
        return self.arguments[self.seam.needs[0]]

    def run(self, **changed: Any) -> Any:
        """Call the host's function, with some arguments ``changed``, by name."""
        if changed:
            bound = self._signature.bind(*self.args, **self.kwargs)
            bound.arguments.update(changed)
            self.result = self.function(*bound.args, **bound.kwargs)
        else:
            self.result = self.function(*self.args, **self.kwargs)
        return self.result

    def how(self, otherwise: Any = None) -> Any:
        """The result of the seam's ``how`` for this call; ``otherwise`` if it has none."""
        return otherwise if self.seam.how is None else self.seam.how(self)


def revised(
    seams: Iterable[Seam], changes: Mapping[str, Mapping[str, Any] | None]
) -> tuple[Seam, ...]:
    """Change an ancestor's table of seams for a descendant.

    Args:
        changes: new field values of a seam, by its attribute; None removes the seam. ValueError if
            there is no such seam.
    """
    table = tuple(seams)
    if missing := changes.keys() - {seam.attribute for seam in table}:
        raise ValueError(f"no seam at {', '.join(sorted(missing))}")
    fields = ((seam, changes.get(seam.attribute, {})) for seam in table)
    return tuple(replace(seam, **new) for seam, new in fields if new is not None)
