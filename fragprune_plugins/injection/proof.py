"""Proves that a host's own rasterizer and our engine draw the same, before anything is trained.

The import name of a rasterizer proves nothing. So the first call at each place is drawn by both,
with the host's own arguments and again with a chart of Gaussians that shows every rule.
"""

from __future__ import annotations

import ast
import hashlib
import logging
import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from fragprune_plugins.constants import VERSION
from fragprune_plugins.engines.cuda.kernels import digest_of_sources
from fragprune_plugins.errors import EngineError, InputError, ProofError
from fragprune_plugins.hosts.adapter import Dialect, HostCall
from fragprune_plugins.hosts.graphdeco.call import ARGUMENTS
from fragprune_plugins.hosts.seams import SeamCall
from fragprune_plugins.hosts.source import parsed
from fragprune_plugins.injection import likeness, proofs
from fragprune_plugins.injection.likeness import Seen
from fragprune_plugins.injection.proofs import Proof

if TYPE_CHECKING:
    from fragprune_plugins.injection.state import SessionState
    from fragprune_plugins.types import RasterInputs, RasterOutputs

log = logging.getLogger("fragprune")

OF_A_VIEW = frozenset(
    {
        *("image_height", "image_width", "tanfovx", "tanfovy", "viewmatrix", "projmatrix"),
        *("campos", "bg", "timestamp", "sh_degree", "prefiltered", "debug"),
    }
)
"""Settings that may change from view to view. A proof covers every SH degree and background;
another value of any other setting needs another proof."""

_DETACHED = ", without gradient"

_SHAPE = ("means3D", "scales", "rotations", "cov3D_precomp")
"""Arguments through which vanilla differentiates its antialiasing as if the covariance were dilated
once more. Ours is the derivative, so antialiased calls are not compared in them."""


def proved(session: SessionState, call: SeamCall, drawn: HostCall, *, strict: bool) -> Proof | None:
    """The proof of a call of the host's own rasterizer, made now if there is none yet.

    None where it failed and may fail, and where our engines do not draw such a call.

    Args:
        session: the state of the session.
        call: at the seam.
        drawn: the same as data.
        strict: False warns where the proof fails.

    Raises:
        ProofError: it draws otherwise, or returns something that the host uses and we do not know.
    """
    place, joint = _place(session), session.learn and not session.freeze
    drawn = replace(drawn, still=not joint)
    shape = (str(call.seam), place, joint, *_shape(drawn))
    if shape not in session.proofs:
        session.proofs[shape] = None
        try:
            session.proofs[shape] = _read_or_prove(session, call, drawn, place, shape)
        except ProofError as error:
            known = getattr(session.dialect, "otherwise", "")
            if strict and not (known or session.trust):
                del session.proofs[shape]
                raise
            log.warning("%s", f"not proved: {error.found}; as known: {known}" if known else error)
        except (EngineError, InputError) as error:  # raised again where ours has to draw
            log.info("not proved: %s", error)
    return session.proofs[shape]


def _read_or_prove(
    session: SessionState, call: SeamCall, drawn: HostCall, place: _Place, shape: tuple[Any, ...]
) -> Proof:
    """A kept proof of a call of this shape, else a new one, which is kept if it fails, too."""
    means = drawn[session.dialect.means]
    engine = session.engine(means.device)
    where = torch.cuda.get_device_name(means.device) if means.is_cuda else "cpu"
    known = (VERSION, digest_of_sources(), session.adapter.name, engine.name, where, shape)
    key = hashlib.sha256(repr(known).encode()).hexdigest()[:16]
    file = sys.modules[call.seam.module].__file__
    kept = proofs.file_of(proofs.digest_of(Path(file)), key) if file else None
    proof = proofs.read(kept) if kept else None
    if proof is None:
        trial = _Trial(session, call, drawn, place)
        try:
            proof = trial.prove()
        except _OtherwiseError as error:
            proof = Proof(trial.where, (), failed=str(error))
        if kept:
            proofs.keep(proof, kept)
    if proof.failed:
        raise ProofError(
            proof.call,
            proof.failed,
            f"what {session.adapter.name} draws, forward and backward",
            "Thresholds would learn from other pictures than its own. fragprune check says whether "
            "its PLY is plain 3DGS, which fragprune finetune prunes; --stage off trains without "
            "thresholds, and --trust with them all the same.",
        )
    log.info("proved: %s", proof)
    return proof


def answer(
    dialect: Dialect,
    call: HostCall,
    inputs: RasterInputs,
    draw: Callable[..., RasterOutputs],
    proof: Proof | None,
) -> Any:
    """Answer a host's call by the dialect, and by what the proof found beyond it.

    An output that is unknown and that the host does not read is the dialect's, or None.
    """
    if proof is None:
        return dialect.answer(call, inputs, draw)
    if not proof.made:
        packed: tuple[Any, ...] = _tuple(dialect.answer(call, inputs, draw))
    else:
        packed, seen = _packed(dialect, call, inputs, draw)
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


# ---- the shape of a call -----------------------------------------------------------------------


def _shape(call: HostCall) -> Iterator[tuple[str, str]]:
    """Which arguments a call has, and every rule that it sets."""
    settings = call.settings._asdict() if hasattr(call.settings, "_asdict") else {}
    for name, value in settings.items():
        if name not in OF_A_VIEW:
            yield name, _rule(value)
    for name, value in call.arguments.items():
        if isinstance(value, Tensor) and name in (*ARGUMENTS, "dc"):
            yield name, str(value.numel() and (*value.shape[1:], value.dtype))
        elif value is not None:
            yield name, _rule(value)


def _rule(value: Any) -> str:
    """A setting's value; of a tensor the number that all its elements are, if there is one."""
    if not isinstance(value, Tensor):
        return repr(value) if isinstance(value, bool | int | float | str | None) else "an object"
    if value.numel() == 0:
        return "empty"
    low, high = (float(each) for each in value.detach().float().aminmax())
    return f"all {low:g}" if low == high else f"{value.ndim} dimensions"


@dataclass(frozen=True)
class _Place:
    """A call in the host's source.

    Attributes:
        name: function, file and line, for people.
        values: what the host names the values that come back; () if it keeps them together.
        unread: numbers of those that its function never reads again.
    """

    name: str
    values: tuple[str, ...] = ()
    unread: frozenset[int] = frozenset()


def _place(session: SessionState) -> _Place:
    """The innermost place in the host's own files that this call comes from."""
    root = session.repo.root
    inside, frame = f"{root / session.repo.package}{os.sep}", sys._getframe(1)
    while frame.f_back is not None:
        file = frame.f_code.co_filename
        if file.startswith(inside) and "site-packages" not in file[len(inside) :]:
            at = f"{frame.f_code.co_name} ({os.path.relpath(file, root)}:{frame.f_lineno})"
            return _read_place(Path(file), frame.f_lineno, at)
        frame = frame.f_back
    return _Place("a call from outside the host")


@cache
def _read_place(file: Path, line: int, at: str) -> _Place:
    around: dict[type, Any] = {}  # the innermost of each kind, because it is walked to last
    for node in ast.walk(parsed(file.read_text(errors="replace")) or ast.Module([], [])):
        if getattr(node, "lineno", line + 1) <= line <= (getattr(node, "end_lineno", 0) or 0):
            around[type(node)] = node
    assigned, function = around.get(ast.Assign), around.get(ast.FunctionDef)
    target = assigned.targets[0] if assigned else None
    if function is None or not isinstance(target, ast.Tuple):
        return _Place(at)
    names = tuple(ast.unparse(each) for each in target.elts)
    nodes = (node for node in ast.walk(function) if isinstance(node, ast.Name))
    read = {node.id for node in nodes if isinstance(node.ctx, ast.Load)}
    unread = {k for k, name in enumerate(names) if name.isidentifier() and name not in read}
    return _Place(at, names, frozenset(unread))


class _OtherwiseError(Exception):
    """The two rasterizers differ; says how."""


# ---- the proof ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Both:
    """One call, drawn by both.

    Attributes:
        what: which arguments, for people.
        leaves: the arguments that get gradients, one row per Gaussian.
        theirs: what the host's rasterizer returned.
        ours: what the dialect answers.
        seen: what our engine draws, with all meanings.
    """

    what: str
    leaves: dict[str, Tensor]
    theirs: tuple[Any, ...]
    ours: tuple[Any, ...]
    seen: Seen


class _Trial:
    """Draws one call of the host by both rasterizers and compares them."""

    def __init__(
        self, session: SessionState, call: SeamCall, drawn: HostCall, place: _Place
    ) -> None:
        self.session, self.call, self.drawn, self.place = session, call, drawn, place
        self.dialect = session.dialect
        self.engine = session.engine(drawn[self.dialect.means].device)
        self.where = f"{call.seam} in {place.name}"
        screens = {name for name in drawn.arguments if name.startswith("means2D")}
        self.unfelt = screens if drawn.still else set()  # only densification reads them

    def prove(self) -> Proof:
        """Compare every output and every gradient.

        Raises:
            _OtherwiseError: names the first difference that matters.
        """
        count, settings = len(self.drawn[self.dialect.means]), self.drawn.settings
        own = {
            name: value
            for name, value in self.drawn.arguments.items()
            if isinstance(value, Tensor) and value.ndim and len(value) == count
        }
        with torch.enable_grad():
            chart = likeness.chart(own, self.dialect.unpack(self.drawn).view)
            both = [
                self._draw("the host's own call", own, settings),
                self._draw("a chart through its camera", chart, self._for_the_chart()),
            ]
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

    def _draw(self, what: str, arguments: dict[str, Tensor], settings: Any) -> _Both:
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
        call = replace(self.drawn, settings=settings, arguments=named, engine=self.engine)
        with torch._C.DisableTorchFunction():  # see ``rasterizing.directly``
            draw = partial(self.engine.rasterize, thresholds=None)
            ours, seen = _packed(
                self.dialect, call, self.dialect.unpack(call), lambda each, _=0: draw(each)
            )
        return _Both(what, leaves, theirs, ours, seen)

    def _output(self, number: int, both: list[_Both]) -> tuple[str, bool]:
        """The meaning of an output, and whether it is another than the dialect answers."""
        theirs = [each.theirs[number] for each in both]
        ours = [dict(enumerate(each.ours)).get(number) for each in both]
        own, chart = both
        said = ours[0] is None or getattr(type(ours[0]), "unread", False)
        unread = number in self.place.unread or (number < len(own.ours) and said)
        is_picture = not likeness.difference(ours[1], chart.seen.drawn.image)
        name, new = likeness.meaning(ours[1], chart.seen) or "as the adapter answers", False
        if told := _first(both, map(likeness.difference, theirs, ours)):
            if is_picture:
                raise _OtherwiseError(f"another picture: {told}")
            name, new = likeness.meaning(theirs[1], chart.seen), True
            if not name or likeness.difference(theirs[0], _made(name, own.seen)):
                if unread:
                    return "something unknown that is not read", False
                raise _OtherwiseError(
                    f"{self._called(number)}, which the host uses, is unknown: {told}"
                )
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
    return next(likeness.gradient_differences(found, expected, leaves), "")


def _gradient(output: Any, leaves: dict[str, Tensor]) -> dict[str, Tensor | None]:
    """Gradients of an output's numbers, weighed at random; None for zero."""
    if not leaves or not isinstance(output, Tensor) or not output.requires_grad:
        return dict.fromkeys(leaves)
    weights = torch.rand(output.numel(), generator=torch.Generator().manual_seed(0)) - 0.3
    found = torch.autograd.grad(
        output,
        list(leaves.values()),
        weights.reshape(output.shape).to(output),
        allow_unused=True,
        retain_graph=True,
    )
    return dict(zip(leaves, found, strict=True))
