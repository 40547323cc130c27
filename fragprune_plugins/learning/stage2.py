"""Stage 2: thresholds learn beside what else trains, whoever drives the training.

This module knows neither a host nor a data set. A driver, which owns the views, the loss and the
optimizer of everything but the thresholds, tells it what happens, in this order in every step:

    begin       the step is counted and planned; new thresholds open; a due target is met
    thresholds  what one rasterization is drawn with
    dropped     a picture to learn from, without some of its Gaussians, if the settings say so
    on_drawn    what came of it; the fragment pressure, a term for the driver's loss, comes back
    on_loss     the loss of the view drawn last went backward
    expect_sound  its gradients must be finite, before the driver's optimizer steps
    end         the driver's optimizer stepped; the thresholds step too

A target (``targets``) is a ratio that thresholds are held to. Fragments "before" are those of a
view drawn without thresholds at its first visit, "after" those it was last drawn with. A speed-up
is the one over the other, summed over views that were learned from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, TypeVar

import torch
from torch import Tensor

from fragprune_plugins.errors import DivergedError, EngineError, ResetError, log
from fragprune_plugins.learning import targets
from fragprune_plugins.learning.events import Progress, StepStats
from fragprune_plugins.learning.finite import are_finite, expect_finite, not_finite
from fragprune_plugins.learning.plain import numbers_of, put
from fragprune_plugins.learning.pressure import Observation, StepViews
from fragprune_plugins.learning.schedule import JointSchedule, Schedule, Settings, StepPlan
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.types import RasterInputs, RasterOutputs

RESET, MOSTLY = 0.0101, 0.9  # the most opacity, in what share of Gaussians, after a reset
LOOKED_AT_EVERY = 10  # steps from one look at all parameters to the next: a look reads all of them
OPAQUE = 0.999  # most that an opacity becomes to make up for Gaussians that a step leaves out
CURVE_POINTS = 100  # thresholds' median, a sort of all rows, is taken this often in a run

_STORED = ("adam_step", "steps", "stop", "rim")
_COUNTED = ("steps", "taken", "_open", "_held", "_median")

View = TypeVar("View")

Truncate = Callable[[RasterInputs, ThresholdStore], Tensor | None]
"""Gives the thresholds (N,) to draw one rasterization with; None draws without."""

_Picture = tuple[Hashable, int]  # a view, and the part of it


def evenly_spaced(views: Sequence[View], most: int) -> Sequence[View]:
    """Views at even distances, so many at most, from the first on."""
    return views[:: max(1, -(-len(views) // most))]


class Stage2:
    """Learning of the thresholds of one population of Gaussians.

    Args:
        store: the thresholds; changed in place.
        schedule: gives the plan of each step; ``Schedule(settings)`` when None.
        truncate: gives the thresholds to draw with; the hook ``fragprune_truncate``.
        views: by view, a call that draws it again, to ``on_drawn``; a target is met on these.
        watch: called after every step.
        parameters: gives by name the tensors that the driver trains; they are checked to be finite.
        target: what thresholds are held to; that of the settings' goal when None.
        everywhere: gives, from the rows of these Gaussians, those of the whole population, if this
            is a part of one.

    Raises:
        UsageError: a training alone cannot meet the goal.
    """

    def __init__(
        self,
        store: ThresholdStore,
        settings: Settings,
        schedule: Schedule | None = None,
        *,
        truncate: Truncate,
        views: Mapping[Any, Callable[[], object]] = MappingProxyType({}),
        watch: Callable[[StepStats], None] | None = None,
        parameters: Callable[[], Mapping[str, Tensor]] = dict,
        target: targets.Target | None = None,
        everywhere: Callable[[Tensor], Tensor] = lambda rows: rows,
    ) -> None:
        self.target = settings.goal.target() if target is None else target
        self.store, self.settings = store, settings
        self.schedule = schedule or Schedule(settings)
        self.pressure = self.schedule.make_pressure()
        self.steps = 0  # begun
        self.taken = 0  # the last that the driver's optimizer took: hosts take none at their end
        self.plan: StepPlan | None = None
        self._truncate, self._again, self._watch = truncate, views, watch
        self._everywhere = everywhere
        self.parameters = parameters
        self.picture = ""  # the view's name, for messages; drivers set it before they draw
        self._open = False  # the warm-up is over
        self._differentiable = False  # what is drawn now has a gradient in the thresholds
        self._held = False  # thresholds have met their target and stay
        # by picture: fragments per pixel
        self._before: dict[_Picture, Tensor] = {}
        self._after: dict[_Picture, Tensor] = {}
        self._views = StepViews(settings.views_per_step)
        self._median = math.nan

    @property
    def learning(self) -> bool:
        """Whether the pressure acts in this step, and thresholds move if they are learned."""
        plan = self.plan
        return plan is not None and plan.learn and self.settings.goal.presses and not self._held

    @property
    def warming_up(self) -> bool:
        """Whether steps were made, and thresholds that will learn have not opened yet."""
        return self.settings.goal.learns and self.steps > 0 and not self._open

    @property
    def viewed(self) -> bool:
        """Whether any view was drawn after thresholds opened."""
        return bool(self._after)

    def knows(self, view: Hashable) -> bool:
        """Whether a view's fragments before learning are known."""
        return (view, 0) in self._before

    def begin(self, opacities: Callable[[], Tensor]) -> StepPlan:
        """A step begins. ``opacities`` gives activated ones, (N,) or (N, 1), if they are needed.

        Raises:
            ResetError: thresholds would begin to learn right after a reset of opacities.
        """
        self.close()
        if self.plan is None:
            self.store.logits.grad = None  # of what was drawn before, in the driver's own training
        self.steps += 1
        self.plan = self.schedule.at(self.steps)
        self._views.begin()
        self._open |= self.plan.learn
        if self.plan.counted:
            self.store.ruled(stop=self.settings.stop_of(self.store.stop), rim=self.settings.rim)
        if not (self.settings.goal.learns or self.store.neutral):
            log.warning("the model's cutoffs are dropped: a %s has none", self.settings.goal.name)
            self.store.replace(len(self.store))
        if self.plan.learn and self.settings.goal.learns:
            if not self.store.opened:
                known = opacities()
                self._expect_no_reset(known)
                self.store.open(known)
            if self.target is not None:
                self._meet_target(self.target, self.plan.progress)
        return self.plan

    def _expect_no_reset(self, opacities: Tensor) -> None:
        """A picture of Gaussians that are hardly there teaches nothing: it has no fragments to cut.

        The pressure, beside so large a loss, would end what is left of it.
        """
        opacities = self._everywhere(opacities)
        share = float((opacities <= RESET).float().mean()) if opacities.numel() else 0.0
        if share < MOSTLY:
            return
        found = f"opacities of at most 0.01 in {share:.0%} of {opacities.numel():,} Gaussians, as "
        found += "a reset of opacities leaves them"
        expected = "a model that has trained on since its last reset"
        remedy = "Train on before stage 2, or let densification, which resets, end earlier (3DGS: "
        remedy += "--densify_until_iter below the last iteration); then --stage finetune."
        error = ResetError("stage 2", found, expected, remedy)
        if not isinstance(self.schedule, JointSchedule):
            raise error
        log.warning("%s", error)  # the host's training goes on, and may recover

    def thresholds(self, inputs: RasterInputs) -> Tensor | None:
        """(N,) to draw a rasterization with, or None; with gradients where they will be used.

        The driver draws it with the store's ``rules``, too.
        """
        if not self.settings.goal.learns:
            return None
        values = self._truncate(inputs, self.store)
        self._differentiable = values is not None and values.requires_grad
        if values is None or self.plan is None or self.learning:
            return values
        return values.detach()

    def dropped(self, inputs: RasterInputs) -> RasterInputs:
        """A picture to learn from, without a random share of its Gaussians (``Settings.dropout``).

        The others are the more opaque, so that a pixel keeps its light in the mean. A model that
        knows its photographs by heart then learns what holds without any single Gaussian
        (DropGaussian, CVPR 2025). Pictures without a gradient are whole; the global random streams
        are not touched.
        """
        share = 0.0 if self.plan is None else 1 - self.plan.progress
        share *= self.settings.dropout or 0.0
        if share == 0 or not torch.is_grad_enabled():
            return inputs
        opacities = inputs.splats.opacities
        where = opacities.device if opacities.is_cuda else "cpu"  # a GPU would wait for a CPU's
        stream = torch.Generator(where).manual_seed(hash((self.settings.seed, self.steps)))
        drawn = torch.rand(len(opacities), generator=stream, device=where)
        kept = drawn.to(opacities.device) >= share
        more = (opacities / (1 - share)).clamp(max=OPAQUE)
        splats = replace(inputs.splats, opacities=torch.where(kept, more, 0.0))
        return replace(inputs, splats=splats)

    def on_drawn(
        self,
        view: Hashable,
        outputs: RasterOutputs,
        untruncated: Callable[[], RasterOutputs],
        part: int = 0,
        area: Tensor | None = None,
    ) -> Tensor | None:
        """A rasterization was drawn with what ``thresholds`` gave.

        Args:
            view: tells views apart.
            untruncated: draws the same without thresholds and stop, at the view's first visit.
            part: of a view whose driver draws several pictures at once.
            area: the ellipses' area per pixel (``area_per_pixel``) for the pressure to act on; the
                drawn fragments when None.

        Returns:
            The pressure, a scalar to add to the loss; None where nothing is to be added.
        """
        picture = view, part
        counted = torch.is_grad_enabled() and self.plan is not None and self.plan.counted
        if counted and picture not in self._before:
            with torch.no_grad():
                self._before[picture] = _fragments_of(untruncated())
        drawn = _fragments_of(outputs)
        if picture in self._before and self._open:
            self._after[picture] = drawn
        if not counted:
            return None
        pressed = outputs.fragments_per_pixel if area is None else area
        self._views.draw(drawn[0], self._before[picture][0], pressed.detach())
        if not self.learning or self.pressure.value == 0:
            return None
        if self._differentiable and not (pressed.requires_grad and outputs.image.requires_grad):
            found = "a picture, or fragments per pixel, without a gradient"
            remedy = "Choose another --engine: this one cannot learn."
            raise EngineError("the engine", found, "both with respect to thresholds", remedy)
        return pressed * (self.pressure.value / self._views.expected)

    def on_loss(self, loss: Tensor) -> None:
        """The loss of the view drawn last, without the pressure, went backward."""
        self._views.lose(loss.detach())

    def rate(self, name: str, base: float) -> float:
        """The learning rate of a group in this step, by its name and its rate before stage 2."""
        if self.plan is None:
            return base
        if name == "opacity" and self.plan.opacity_lr is not None:
            return self.plan.opacity_lr
        return base * self.plan.decay

    def expect_sound(self) -> None:
        """Raise DivergedError if a gradient, or its square, is NaN or infinite."""
        given = {**self.parameters(), "thresholds": self.store.logits}.items()
        known = {name: each.grad.to_dense() for name, each in given if each.grad is not None}
        if are_finite(known.values()):
            return
        broken = not_finite({name: each.float().square() for name, each in known.items()})
        if not broken:  # very large, and Adam can take it
            return
        where = f"stage 2, step {self.steps}" + (f", view {self.picture}" if self.picture else "")
        found = f"NaN or infinity in the gradient of {', '.join(broken)}"
        remedy = "Nothing of it was taken over. Look at that view and its photograph."
        raise DivergedError(where, found, "finite gradients", remedy)

    def end(self) -> None:
        """The driver's optimizer has stepped: so do the thresholds.

        Raises:
            DivergedError: NaN or infinity in them; every tenth step and in the last in all else.
        """
        if self.plan is None:  # a step before stage 2 is the driver's own
            return
        self.taken = self.steps
        if self.learning and self.settings.goal.learns:
            self.store.step(self.plan.threshold_lr)
        looked_at = [self.store.logits]
        if self.steps % LOOKED_AT_EVERY == 0 or self.steps == self.settings.iterations:
            looked_at += self.parameters().values()
        if not are_finite(looked_at):
            self.check()

    def close(self) -> None:
        """A step is over and known whole: tell the pressure and whoever watches. Once a step."""
        plan, views = self.plan, self._views
        if plan is None or not views.drawn:
            return
        every = max(1, self.settings.iterations // CURVE_POINTS)
        if math.isnan(self._median) or self.steps % every == 0:
            self._median = float(self._everywhere(self.store.values.detach()).median())
        fragments, untruncated, pressed = views.means()
        stats = StepStats(self.steps, fragments, self.pressure.value, self._median, views.loss)
        if self.learning:
            ratio = max(untruncated, 1e-9) / max(pressed, 1e-9)
            if self.target is not None:
                ratio = self.target.followed(ratio)
            self.pressure.observe(Observation(plan.progress, pressed, ratio, stats.loss))
        views.begin()  # first, so that whoever watches may raise
        if self._watch is not None:
            self._watch(stats)

    def check(self) -> None:
        """Raise DivergedError unless everything that trains is finite; before anything is saved."""
        where = f"stage 2, after step {self.steps}"
        expect_finite({**self.parameters(), **self.store.numbers}, where)

    def progress(self) -> Progress:
        """The state so far."""
        before = _mean({p: self._before[p] for p in self._after or self._before})
        after, reached, target = _mean(self._after), None, self.target
        figures = {"speedup": before / after if before is not None and after else None}
        if target is not None:
            figures |= {} if target.met is None else {target.figure: target.met}
            ratio = figures.get(target.figure)
            reached = ratio is not None and abs(target.ratio / ratio - 1) <= targets.TOLERANCE
        return Progress(
            steps=max(0, self.taken + 1 - self.schedule.from_step),
            gaussians=len(self.store),
            fragments_before=before,
            fragments_after=after,
            speedup=figures["speedup"],
            faster=figures.get("faster"),
            target_reached=reached,
            pressure=self.pressure.value,
        )

    def state_dict(
        self, order: Iterable[Hashable] | None = None
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Tensors and plain values from which ``load_state_dict`` goes on, between two steps.

        They hold nothing that the driver owns.

        Args:
            order: all views, in the order that they have at every start; that of ``views`` if None.
        """
        self.close()
        number = {view: index for index, view in enumerate(order or self._again)}
        tensors = self.store.state_dict()
        plain: dict[str, Any] = {"store": [tensors.pop(name, None) for name in _STORED]}
        for name, figures in (("before", self._before), ("after", self._after)):
            known = {(number[v], part): each for (v, part), each in figures.items() if v in number}
            plain[name] = list(known)
            if known:
                tensors[name] = torch.stack(list(known.values()))
        plain |= {name: getattr(self, name) for name in _COUNTED}
        plain |= {"expected": self._views.expected, "pressure": numbers_of(self.pressure)}
        plain["target"] = self.target and self.target.state()
        return tensors, plain

    def load_state_dict(
        self,
        tensors: Mapping[str, Tensor],
        plain: Mapping[str, Any],
        order: Iterable[Hashable] | None = None,
    ) -> None:
        """Go on where ``state_dict`` was called, with the same settings and views, to the bit.

        Raises:
            SidecarError: the thresholds' parts do not fit together, or are not finite.
            ValueError: a plain value is none that ``state_dict`` gives.
        """
        self.store.load_state_dict(stored_thresholds(tensors, plain))
        views = list(order or self._again)
        for name, figures in (("before", self._before), ("after", self._after)):
            for (view, part), figure in zip(plain[name], tensors.get(name, ()), strict=True):
                figures[views[view], part] = figure.to(self.store.logits.device)
        put(self, {name: plain[name] for name in _COUNTED})
        if self.target is not None:
            self.target.load_state(plain["target"])
        put(self._views, {"expected": plain["expected"]})
        put(self.pressure, plain["pressure"])

    def _meet_target(self, target: targets.Target, progress: float) -> None:
        """Late in the run, and again before its last step, shift all thresholds onto the target."""
        known = dict.fromkeys(view for view, _ in self._before if view in self._again)
        views = evenly_spaced([*known], targets.CALIBRATION_VIEWS)
        due = progress >= 1.0 or (progress >= targets.CALIBRATE_AT and not self._held)
        if not views or (self._held and not due):
            return

        @torch.no_grad()
        def ratio() -> float:
            """Fragments before over after, of all views; infinite beyond what a target may."""
            for view in views:
                self._again[view]()
            pictures = [picture for picture in self._before if picture[0] in views]
            before, after = (
                sum(float(drawn[each]) for each in pictures)
                for drawn in (self._before, self._after)
            )
            return before / max(after, 1e-9) if before < targets.FEWEST * after else math.inf

        if due:
            target.meet(self.store, ratio, views)
            self._held = True
        else:
            target.look(progress, ratio, views)


def stored_thresholds(tensors: Mapping[str, Tensor], plain: Mapping[str, Any]) -> dict[str, Any]:
    """The state of the store in what ``Stage2.state_dict`` gave."""
    state = dict(zip(_STORED, plain["store"], strict=True))
    return {**tensors, **state, "rim": state["rim"] or "hard"}


def _fragments_of(outputs: RasterOutputs) -> Tensor:
    """(1,) drawn per pixel."""
    return outputs.fragments_per_pixel.detach().reshape(1)


def _mean(figures: Mapping[_Picture, Tensor]) -> float | None:
    return float(torch.stack(list(figures.values())).mean()) if figures else None
