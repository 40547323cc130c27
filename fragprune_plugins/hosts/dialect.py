"""How a host calls its rasterizer: the call as data, its translation, and a proof of both."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from fragprune_plugins.hosts.seams import SeamCall
from fragprune_plugins.hosts.source import HostRepo

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.engines import Engine
    from fragprune_plugins.types import RasterInputs, RasterOutputs


@dataclass(frozen=True)
class HostCall:
    """The host's call of its rasterizer as data, with all arguments by name.

    Attributes:
        settings: the host's rasterizer settings.
        arguments: of the call, by name.
        entry: the function called, "module:attribute" as seams spell it.
        engine: draws the call; dialects may compute with it first.
        still: stage 2 has begun, in which no strategy of the host reads gradients.
    """

    settings: Any
    arguments: Mapping[str, Any]
    entry: str = ""
    engine: str | Engine = "auto"
    still: bool = False

    @classmethod
    def of(cls, call: SeamCall) -> HostCall:
        """Build from a call at a RASTERIZE seam; arguments in ``**more`` are kept by name."""
        settings = getattr(call.instance, "raster_settings", None)
        named = call.arguments
        return cls(settings, named | named.get("more", {}), str(call.seam))

    def get(self, name: str) -> Tensor | None:
        """A tensor argument, or None if it is absent, None or empty (hosts pass all three)."""
        value: Tensor | None = self.arguments.get(name)
        return None if value is None or value.numel() == 0 else value

    def __getitem__(self, name: str) -> Tensor:
        value: Tensor = self.arguments[name]
        return value


@dataclass(frozen=True)
class Place:
    """A call in the host's source.

    Attributes:
        name: function, file and line, for people.
        values: what the host names the values that come back; () if it keeps them together.
        unread: numbers of the values that its function never reads again.
    """

    name: str
    values: tuple[str, ...] = ()
    unread: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Proof:
    """A call of a host's rasterizer that was drawn by both, the same way or not.

    Attributes:
        call: the rasterizer, and the place of the call in the host's source.
        outputs: what each returned value is, in order.
        made: by the number of an output, its meaning, where the proof found another than the
            dialect answers.
        failed: how it draws otherwise; "" if it does not.
    """

    call: str
    outputs: tuple[str, ...]
    made: dict[int, str] = field(default_factory=dict)
    failed: str = ""

    def __str__(self) -> str:
        returned = f"returns {', '.join(self.outputs)}"
        return f"{self.call}: {self.failed}" if self.failed else f"{self.call} {returned}"


class Prover(ABC):
    """Compares a host's own rasterizer with our engines, for the calls of one dialect."""

    otherwise: str = ""
    """How it is known to draw otherwise than ours; a proof that fails then warns."""

    @abstractmethod
    def shape(self, call: HostCall) -> Iterable[Any]:
        """The arguments and rules of a call; one proof covers all calls of the same shape."""

    @abstractmethod
    def prove(self, call: SeamCall, drawn: HostCall, place: Place) -> Proof:
        """Draw a call both ways, ``drawn`` with the engine; compare every output and gradient."""

    @abstractmethod
    def answer(
        self, call: HostCall, inputs: RasterInputs, draw: Callable[..., RasterOutputs], proof: Proof
    ) -> Any:
        """Answer a call as ``Dialect.answer`` does, and with the outputs that the proof found."""


class Dialect(ABC):
    """Translates one revision's rasterizer call into ``RasterInputs``, and the outputs back."""

    means: ClassVar[str] = "means3D"
    """What the call names the (N, 3) means."""

    own_kernels: ClassVar[Literal["", "gpu", "compiler"]] = ""
    """What compiled modules inside the host's own package need: a "gpu"; or also CUDA's "compiler",
    because they are compiled when they are imported. "" if there are none."""

    unneeded: ClassVar[Mapping[str, Mapping[str, Any]]] = MappingProxyType({})
    """Packages that the host can do without on a CPU, by import name: what it needs of each."""

    def unproved(self, repo: HostRepo) -> str:
        """What reading a host cannot show of its pictures; "" if it shows their rule."""
        return "the picture, until it is compared on the first run"

    @property
    def prover(self) -> Prover | None:
        """Compares the host's own rasterizer with our engines; None if nothing does."""
        return None

    @abstractmethod
    def unpack(self, call: HostCall) -> RasterInputs:
        """Translate the host's call into ``RasterInputs``."""

    def rows_drawn(self, model: Any, call: HostCall) -> Tensor | None:
        """Rows (M,) int64 of the model that a call draws, in its order; None for all.

        Raises:
            AlignmentError: the call's Gaussians cannot be matched to rows of the model.
        """
        return None

    @abstractmethod
    def answer(
        self, call: HostCall, inputs: RasterInputs, draw: Callable[..., RasterOutputs]
    ) -> Any:
        """Draw, and translate outputs into what the host expects; perhaps several times.

        Args:
            inputs: the result of ``unpack``.
            draw: rasterizes inputs with the thresholds of this call. If one call has several
                cameras, a second argument numbers them from 0.
        """

    @abstractmethod
    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """Stand-ins for the host's compiled packages, by import name.

        Args:
            draw: answers a host call without thresholds.
        """

    def names(self) -> frozenset[str]:
        """The import names in ``modules``; these packages need not be installed."""
        return frozenset(self.modules(lambda call: None))
