"""Proves that a rasterizer of these hosts and our engine draw the same.

A call is drawn by both, as the host makes it and again with Gaussians that show every rule.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fragprune_graphdeco import likeness
from fragprune_graphdeco.call import ARGUMENTS
from fragprune_graphdeco.likeness import Seen
from fragprune_plugins.adapting import (
    Dialect,
    HostCall,
    Place,
    Proof,
    Prover,
    RasterInputs,
    RasterOutputs,
    SeamCall,
)

OF_A_VIEW = frozenset(
    {
        *("image_height", "image_width", "tanfovx", "tanfovy", "viewmatrix", "projmatrix"),
        *("campos", "bg", "timestamp", "sh_degree", "prefiltered", "debug"),
    }
)
"""Settings that may change from view to view. A proof covers every SH degree, and black or every
other background; another value of any other setting needs another proof."""

_DETACHED = ", without gradient"

_OWN = sha256(
    b"".join(Path(each).read_bytes() for each in (__file__, likeness.__file__))
).hexdigest()
"""Another proof proves anew."""

_FROM_BLACK = 1e-3  # added to the constant harmonics of a host's call, far more than rounding

_SHAPE = ("means3D", "scales", "rotations", "cov3D_precomp")
"""Arguments through which vanilla differentiates its antialiasing as if the covariance were dilated
once more. Ours is the derivative, so antialiased calls are not compared in them."""


@dataclass(frozen=True)
class RasterizerProver(Prover):
    """Compares any rasterizer that takes the calls of a dialect of this family."""

    dialect: Dialect
    otherwise: str = ""

    def shape(self, call: HostCall) -> Iterator[tuple[str, str]]:
        """Which arguments a call has, every rule that it sets, and what proves it."""
        yield "proved by", _OWN
        settings = call.settings._asdict() if hasattr(call.settings, "_asdict") else {}
        for name, value in settings.items():
            if name == "bg":
                black = isinstance(value, Tensor) and not value.any()  # it may be left out
                yield name, "black" if black else "lit"
            elif name not in OF_A_VIEW:
                yield name, _rule(value)
        for name, value in call.arguments.items():
            if isinstance(value, Tensor) and name in (*ARGUMENTS, "dc"):
                yield name, str(value.numel() and (*value.shape[1:], value.dtype))
            elif value is not None:
                yield name, _rule(value)

    def prove(self, call: SeamCall, drawn: HostCall, place: Place) -> Proof:
        """Compare every output and every gradient."""
        with torch.inference_mode(False), torch.enable_grad():  # a host may draw in either
            given, settings = _derivable(drawn.arguments), _derivable(drawn.settings)
            drawn = replace(drawn, arguments=given, settings=settings)
            trial = _Trial(self.dialect, call, drawn, place)
            try:
                return trial.prove()
            except _OtherwiseError as error:
                return Proof(trial.where, (), failed=str(error))

    def answer(
        self, call: HostCall, inputs: RasterInputs, draw: Callable[..., RasterOutputs], proof: Proof
    ) -> Any:
        """Answer by the dialect, and by what the proof found beyond it.

        An output that is unknown and that the host does not read is the dialect's, or None.
        """
        if not proof.made:
            packed: tuple[Any, ...] = _tuple(self.dialect.answer(call, inputs, draw))
        else:
            packed, seen = _packed(self.dialect, call, inputs, draw)
        answered = [*packed, *[None] * (len(proof.outputs) - len(packed))]
        for number, name in proof.made.items():
            answered[number] = _made(name, seen)
        return tuple(answered) if len(answered) > 1 else answered[0]


def _packed(
    dialect: Dialect, call: HostCall, inputs: RasterInputs, draw: Callable[..., RasterOutputs]
) -> tuple[tuple[Any, ...], Seen]:
    """The dialect's answer, and what the engine draws with all meanings."""
    seen: list[Seen] = []

    def drawing(each: RasterInputs, *part: int) -> RasterOutputs:
        drawn = draw(likeness.widened(each), *part)
        seen.append(Seen(drawn, each, lambda other: draw(other, *part)))
        return likeness.narrowed(drawn)

    return _tuple(dialect.answer(call, inputs, drawing)), seen[0]


def _made(name: str, seen: Seen) -> Any:
    value = likeness.MEANINGS[name.removesuffix(_DETACHED)](seen)
    return value.detach() if value is not None and name.endswith(_DETACHED) else value


def _tuple(answered: Any) -> tuple[Any, ...]:
    return tuple(answered) if isinstance(answered, tuple | list) else (answered,)


def _derivable(value: Any) -> Any:
    """A value, or the values of a mapping or a named tuple; copies of what inference mode made."""
    if isinstance(value, Mapping):
        return {name: _derivable(each) for name, each in value.items()}
    if hasattr(value, "_replace"):
        return value._replace(**_derivable(value._asdict()))
    return value.clone() if isinstance(value, Tensor) and value.is_inference() else value


def _rule(value: Any) -> str:
    """A setting's value; of a tensor the number that all its elements are, if there is one."""
    if not isinstance(value, Tensor):
        return repr(value) if isinstance(value, bool | int | float | str | None) else "an object"
    if value.numel() == 0:
        return "empty"
    low, high = (float(each) for each in value.detach().float().aminmax())
    return f"all {low:g}" if low == high else f"{value.ndim} dimensions"


class _OtherwiseError(Exception):
    """The two rasterizers differ; says how."""


# ---- the proof ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Both:
    """One call, drawn by both."""

    what: str  # which arguments, for people
    leaves: dict[str, Tensor]  # the arguments that get gradients, one row per Gaussian
    theirs: tuple[Any, ...]  # what the host's rasterizer returned
    ours: tuple[Any, ...]  # what the dialect answers
    seen: Seen  # what our engine draws, with all meanings
    slack: int  # how many times more they may differ than by rounding alone


class _Trial:
    """Draws one call of the host by both rasterizers and compares them."""

    def __init__(self, dialect: Dialect, call: SeamCall, drawn: HostCall, place: Place) -> None:
        self.dialect, self.call, self.drawn, self.place = dialect, call, drawn, place
        self.where = f"{call.seam} in {place.name}"
        screens = {name for name in drawn.arguments if name.startswith("means2D")}
        self.unfelt = screens if drawn.still else set()  # only densification reads them

    def prove(self) -> Proof:
        """Compare every output and every gradient, up to the first difference that matters."""
        count, settings = len(self.drawn[self.dialect.means]), self.drawn.settings
        own = {
            name: value
            for name, value in self.drawn.arguments.items()
            if isinstance(value, Tensor) and value.ndim and len(value) == count
        }
        band = "shs" if own.get("dc") is None else "dc"
        if band in own:  # black points lie where colours are cut, and rounding says on which side
            own[band] = own[band].detach().clone(memory_format=torch.contiguous_format)
            own[band].view(count, -1)[:, :3] += _FROM_BLACK
        here = torch.device("cpu")  # whatever the host makes torch's default
        with here:
            chart = likeness.chart(own, self.dialect.unpack(self.drawn).view)
        both = [
            self._draw("the host's own call", own, settings, likeness.OWN),
            self._draw("a chart through its camera", chart, self._for_the_chart(), 1),
        ]
        with here:
            found = [self._output(number, both) for number in range(len(both[0].theirs))]
        made = {number: name for number, (name, new) in enumerate(found) if new}
        return Proof(self.where, tuple(name for name, _ in found), made)

    def _for_the_chart(self) -> Any:
        """The call's settings with all SH bands that its coefficients allow, not antialiased."""
        settings, sh, dc = self.drawn.settings, self.drawn.get("shs"), self.drawn.get("dc")
        changed: dict[str, Any] = {}
        if sh is not None and settings.sh_degree < 3:
            count = sh.shape[1] + (dc is not None)
            changed["sh_degree"] = max(settings.sh_degree, min(3, int(count**0.5) - 1))
        if getattr(settings, "antialiasing", False):
            changed["antialiasing"] = False
        return settings._replace(**changed) if changed else settings

    def _draw(self, what: str, arguments: dict[str, Tensor], settings: Any, slack: int) -> _Both:
        excused = _SHAPE if getattr(settings, "antialiasing", False) else ()
        leaves = {
            name: each.detach().requires_grad_()
            for name, each in arguments.items()
            if (each.requires_grad or name in (*ARGUMENTS, "dc")) and name not in excused
        }
        given = {**arguments, **leaves}
        rasterizer = self.call.instance
        rasterizer.raster_settings = settings
        try:
            theirs = _tuple(self.call.run(**given))
        finally:
            rasterizer.raster_settings = self.drawn.settings
        named = {**self.drawn.arguments, **given}
        call = replace(self.drawn, settings=settings, arguments=named)
        with torch._C.DisableTorchFunction():  # a CPU's detour of the host's calls
            draw = partial(self.drawn.engine.rasterize, thresholds=None)  # type: ignore[union-attr]
            ours, seen = _packed(
                self.dialect, call, self.dialect.unpack(call), lambda each, _=0: draw(each)
            )
        return _Both(what, leaves, theirs, ours, seen, slack)

    def _output(self, number: int, both: list[_Both]) -> tuple[str, bool]:
        """The meaning of an output, and whether it is another than the dialect answers."""
        theirs = [each.theirs[number] for each in both]
        ours = [dict(enumerate(each.ours)).get(number) for each in both]
        own, chart = both
        said = ours[0] is None or getattr(ours[0], "unread", False)
        unread = number in self.place.unread or (number < len(own.ours) and said)
        is_picture = not likeness.difference(ours[1], chart.seen.drawn.image)
        name, new = likeness.meaning(ours[1], chart.seen) or "as the adapter answers", False
        slacks = [each.slack for each in both]
        if told := _first(both, map(likeness.difference, theirs, ours, slacks)):
            if is_picture:
                raise _OtherwiseError(f"another picture: {told}")
            name, new = likeness.meaning(theirs[1], chart.seen), True
            if not name or likeness.difference(theirs[0], _made(name, own.seen), own.slack):
                if unread:
                    return "something unknown that is not read", False
                unknown = f"{self._called(number)}, which the host uses, is unknown"
                raise _OtherwiseError(f"{unknown}: {told}")
            ours = [_made(name, each.seen) for each in both]
        if unread and not is_picture:
            return name, new
        differ = partial(_gradient_difference, chart.leaves.keys() - self.unfelt)
        wrong = _first(both, map(differ, both, theirs, ours))
        if wrong and new:
            name += _DETACHED
            ours = [_made(name, each.seen) for each in both]
            wrong = _first(both, map(differ, both, theirs, ours)) and wrong
        if wrong:
            raise _OtherwiseError(f"another backward pass from {self._called(number)}: {wrong}")
        differ = partial(_gradient_difference, self.unfelt)
        if is_picture and _first(both, map(differ, both, theirs, ours)):
            name += ", with another gradient on the screen, which stage 2 does not read"
        return name, new

    def _called(self, number: int) -> str:
        known = number < len(self.place.values)
        return f"output {number + 1}{f' ({self.place.values[number]})' if known else ''}"


def _first(both: list[_Both], told: Iterable[str]) -> str:
    """The first difference, and in which drawing; "" without one."""
    found = (f"in {each.what} {what}" for each, what in zip(both, told, strict=True) if what)
    return next(found, "")


def _gradient_difference(names: Collection[str], both: _Both, theirs: Any, ours: Any) -> str:
    """The first difference between the gradients of two outputs in some arguments, or ""."""
    leaves = {name: leaf for name, leaf in both.leaves.items() if name in names}
    found, expected = (_gradient(each, leaves) for each in (theirs, ours))
    return next(likeness.gradient_differences(found, expected, leaves, both.slack), "")


def _gradient(output: Any, leaves: dict[str, Tensor]) -> dict[str, Tensor | None]:
    """Gradients of an output's numbers, weighed at random; None for zero."""
    if not leaves or not isinstance(output, Tensor) or not output.requires_grad:
        return dict.fromkeys(leaves)
    weights = torch.rand(output.numel(), generator=torch.Generator().manual_seed(0)) - 0.3
    given = output, list(leaves.values()), weights.reshape(output.shape).to(output)
    found = torch.autograd.grad(*given, allow_unused=True, retain_graph=True)
    return dict(zip(leaves, found, strict=True))
