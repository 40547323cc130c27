"""Gaussians that are divided among processes: each holds some, and draws a view of its own.

As in gsplat's ``distributed`` rasterization and Grendel-GS, a process sends those of its Gaussians
that can reach a pixel of a view to the process that draws it: 60 bytes each, with a colour instead
of spherical harmonics. Gradients take the same way back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from fragprune_plugins import constants
from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import InputError, RanksError, UsageError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.slicing.cutting import slice_at
from fragprune_plugins.slicing.splats import Moment, SpacetimeSplats
from fragprune_plugins.types import RasterInputs, RasterOutputs, Splats, View
from fragprune_plugins.workbench.finetune.processes import Processes
from fragprune_plugins.workbench.ranks import Ranks

_SENT = ("means", "opacities", "scales", "rotations", "cov3d")  # with colours and thresholds

_SEEN, _POSE = ("width", "height", "tan_fov_x", "tan_fov_y"), ("viewmatrix", "projmatrix", "campos")
_RULES = ("scale_modifier", "dilation", "near")  # what each tells the others, beside its view
_WIDER, _BEYOND = 1.001, 1.0  # a factor, and pixels: how much farther one may reach, by rounding
_PER_GAUSSIAN = ("radii", "fragments_per_gaussian")


class ShardedEngine:
    """Rasterizes Gaussians that are divided among processes, by an engine of one kind in all.

    ``rasterize`` is a collective operation. All processes call it, in the same order, each with its
    own Gaussians and with the view that it draws itself. The result is that view of the Gaussians
    of all processes, in their order: on the cpu engine the same, to the bit, as of all of them in
    one process. A backward pass is collective as well.

    Outputs with a row for each Gaussian have one for each of this process' own, in its own view.
    Radii are 0 of those that reach none of its pixels. ``sent`` counts the Gaussians that this
    process has sent to others.
    """

    def __init__(self, engine: Engine, ranks: Ranks) -> None:
        self.engine, self.ranks = engine, ranks
        self.name, self.sent = engine.name, 0

    def rasterize(self, inputs: RasterInputs, thresholds: Tensor | None) -> RasterOutputs:
        """Draw this process' view of all Gaussians.

        Args:
            inputs: the view; and ``Splats`` of this process, without features.
            thresholds: (N,) of this process' Gaussians, falloff in (0, 1); or None, if in all.

        Raises:
            InputError: inputs of a kind that is not sent to other processes.
            RanksError: another process is gone, or called with inputs of another kind.
        """
        inputs.check_thresholds(thresholds)
        splats = _expect_sendable(inputs)
        known = {name: getattr(splats, name) for name in _SENT} | {"thresholds": thresholds}
        given = {name: each for name, each in known.items() if each is not None}
        views = self._views(inputs, given)
        thresholds = given.get("thresholds")
        rows = [reaching(each, splats, thresholds) for each in views]
        chosen = torch.cat(rows)
        parts = {name: each.index_select(0, chosen) for name, each in given.items()}
        seen = zip(rows, views, strict=True)
        parts["colors"] = torch.cat([self._colors(splats, ids, at.view) for ids, at in seen])
        rank, to = self.ranks.rank, [len(ids) for ids in rows]  # how many each gets of this one
        by = [counts[rank] for counts in self.ranks.gather(to)]  # and this one of each
        self.sent += sum(to) - to[rank]
        received = self._exchange(parts, to, by)
        cut = received.pop("thresholds", None)
        drawn = Splats(**received)  # type: ignore[arg-type]
        outputs = self.engine.rasterize(replace(inputs, splats=drawn), cut)
        own, before = rows[rank], by[:rank]
        local = {
            name: each.new_zeros(len(splats)).index_copy(0, own, each[sum(before) :][: len(own)])
            for name in _PER_GAUSSIAN
            if (each := getattr(outputs, name)) is not None
        }
        return replace(outputs, **local)

    def _views(self, inputs: RasterInputs, given: dict[str, Tensor]) -> list[RasterInputs]:
        """The views of all processes, by rank, with the rules that they are drawn by.

        If other processes have thresholds, and this one none, neutral ones are put into ``given``.
        """
        view = inputs.view
        kinds = [  # absent, there, there with a gradient
            0 if (each := given.get(name)) is None else 1 + each.requires_grad
            for name in (*_SENT, "thresholds")
        ]
        seen = {name: getattr(view, name) for name in _SEEN}
        seen |= {name: getattr(view, name).detach().cpu() for name in _POSE}
        rules = {name: getattr(inputs, name) for name in _RULES}
        known = self.ranks.gather((kinds, seen, rules))
        cut = max(kind[-1] for kind, _, _ in known)
        for rank, (kind, _, _) in enumerate(known):
            if kind[:-1] != kinds[:-1] or kind[-1] not in (0, cut):
                where = f"process {self.ranks.rank} of {self.ranks.size}"
                found = f"process {rank} draws Gaussians of another kind"
                same = f"the same of {', '.join(_SENT)} in all, with the same needs of gradients"
                remedy = "Call all with equal arguments but for the Gaussians and the view."
                raise RanksError(where, found, same, remedy)
        if cut and "thresholds" not in given:
            neutral = torch.full((len(inputs.splats),), constants.NEUTRAL_LOGIT)
            neutral = neutral.to(inputs.splats.device).sigmoid()
            given["thresholds"] = neutral.requires_grad_(cut > 1)
        at = view.viewmatrix.device
        given_views = [(replace(view, **seen).to(at), rules) for _, seen, rules in known]
        return [replace(inputs, view=each, **rules) for each, rules in given_views]

    def _colors(self, splats: Splats, ids: Tensor, view: View) -> Tensor:
        """(M, 3) RGB of chosen Gaussians as a view sees them."""
        if splats.colors is not None:
            return splats.colors.index_select(0, ids)
        assert splats.sh is not None
        chosen = SpacetimeSplats(
            means=splats.means.index_select(0, ids),
            opacities=splats.opacities.detach().index_select(0, ids),
            cov3d=splats.means.new_zeros(len(ids), 6),  # colours do not depend on it
            sh=splats.sh.index_select(0, ids),
            sh_degree=splats.sh_degree,
        )
        colors = slice_at(chosen, Moment(0.0, view.campos), engine=self.engine).colors
        assert colors is not None
        return colors

    def _exchange(
        self, parts: Mapping[str, Tensor], to: list[int], by: list[int]
    ) -> dict[str, Tensor]:
        """The rows that all processes send to this one. What needs no gradient gets none back."""
        received: dict[str, Tensor] = {}
        for moving in (True, False):
            group = {name: each for name, each in parts.items() if each.requires_grad == moving}
            if not group:
                continue
            widths = [each.shape[1:].numel() for each in group.values()]
            pairs = zip(group.values(), widths, strict=True)
            table = torch.cat([each.reshape(-1, width) for each, width in pairs], dim=1)
            table = _Exchange.apply(table, self.ranks, to, by)  # type: ignore[no-untyped-call]
            for (name, each), piece in zip(group.items(), table.split(widths, dim=1), strict=True):
                received[name] = piece.reshape(-1, *each.shape[1:])
        return received


class _Exchange(torch.autograd.Function):
    """Rows from all processes to all; gradients go back the same way."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, ranks: Ranks, to: list[int], by: list[int]) -> Tensor:
        ctx.ranks, ctx.to, ctx.by = ranks, to, by
        return ranks.exchange(rows, to, by)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.ranks.exchange(grad, ctx.by, ctx.to), None, None, None


@torch.no_grad()
def reaching(inputs: RasterInputs, splats: Splats, thresholds: Tensor | None) -> Tensor:
    """(M,) int64, ascending: those ``splats`` that may have a fragment in a view, or at their rim.

    A fragment lies within its Gaussian's cutoff. A sphere around the cutoff is projected; those
    whose image touches no pixel are left out, and those that are too faint everywhere.
    """
    view, means = inputs.view, splats.means
    rotation = view.viewmatrix[:3, :3]
    spread = means[:, :, None]  # no products of matrices, which may be those of TF32
    x, y, depth = ((spread * rotation).sum(1) + view.viewmatrix[3, :3]).unbind(1)
    clip = (spread * view.projmatrix[:3]).sum(1) + view.projmatrix[3]
    q = 2 * (splats.opacities / constants.ALPHA_MIN).log()
    if thresholds is not None and inputs.rim == "hard":  # a soft one reaches farther
        rim = thresholds - constants.RIM_REACH * constants.RIM_WIDTH
        rim = rim.clamp_min(constants.FALLOFF_MIN)
        q = torch.minimum(q, -2 * torch.minimum(rim, thresholds).log())
    kept = (depth > inputs.near) & (q > 1 - _WIDER)
    q, largest = q.clamp_min(0), _largest_variance(inputs, splats)
    forward = rotation[:, 2]
    for axis, place, side, tan in (
        (0, x, view.width, view.tan_fov_x),
        (1, y, view.height, view.tan_fov_y),
    ):
        limit, across = constants.FRUSTUM_MARGIN * tan, rotation[:, axis]
        slope = (place / depth).clamp(-limit, limit)
        steep = across @ across + slope * (slope * (forward @ forward) - 2 * (across @ forward))
        variance = largest * steep * (side / (2 * tan) / depth).square() + inputs.dilation
        reach = _WIDER * (q * variance).sqrt() + _BEYOND
        centre = ((clip[:, axis] / (clip[:, 3] + 1e-7) + 1) * side - 1) / 2
        kept &= (centre + reach >= 0) & (centre - reach <= side - 1)
    return kept.nonzero()[:, 0]


def _largest_variance(inputs: RasterInputs, splats: Splats) -> Tensor:
    """(N,) at least each Gaussian's variance along any direction, world units squared."""
    if splats.cov3d is not None:
        return splats.cov3d[:, [0, 3, 5]].sum(1)
    assert splats.scales is not None
    assert splats.rotations is not None
    norm = splats.rotations.square().sum(1)  # 1, unless a host does not normalise them
    longer = norm + (1 - norm).abs()
    return (inputs.scale_modifier * splats.scales.amax(1) * longer).square()


def _expect_sendable(inputs: RasterInputs) -> Splats:
    """The Gaussians, if they and the rules are of a kind that other processes can draw."""
    splats = inputs.splats
    given = {
        "Footprints": not isinstance(splats, Splats),
        "surfels": splats.flat,
        "features": splats.features is not None,
        "means2d_hook": inputs.means2d_hook is not None,
        "sample_offsets": inputs.sample_offsets is not None,
        "scores": inputs.scores,
    }
    if wrong := ", ".join(name for name, there in given.items() if there):
        found = f"{wrong}, and Gaussians divided among processes"
        expected = "3D Gaussians in space, without them"
        raise InputError("RasterInputs", found, expected, "Draw in one process.")
    assert isinstance(splats, Splats)
    return splats


class Shards(Processes):
    """Processes that each hold a part of the model's Gaussians; this one holds ``count``."""

    divided = True

    def __init__(self, ranks: Ranks, count: int) -> None:
        super().__init__(ranks)
        self.counts: list[int] = ranks.gather(count)

    def expect_able(self, settings: Settings) -> None:
        """Refuse views that cannot be divided, and an area that no process sees whole."""
        if settings.goal.on_area:
            found = "portable, and Gaussians divided among processes"
            expected = "thresholds, or the whole model in each process"
            remedy = "Leave --portable or --shard-gaussians out."
            raise UsageError("finetune", found, expected, remedy)
        super().expect_able(settings)

    def _told(self, leaves: Sequence[Tensor]) -> list[Tensor]:
        """0, or NaN for a gradient that is not finite: as in a sum, it is everybody's then."""
        none = leaves[0].new_zeros(())
        return [none if each.grad is None else (0 * each.grad).sum() for each in leaves]

    def _gradient(self, leaf: Tensor, total: Tensor) -> Tensor:
        return total.expand_as(leaf).clone() if leaf.grad is None else leaf.grad + total

    def stepped(self, learned: Mapping[str, Tensor], step: int, *, last: bool = False) -> None:
        """Do nothing: no two processes hold the same Gaussian."""

    def total(self, count: int) -> int:
        """Gaussians of all processes."""
        return sum(self.counts)

    def everywhere(self, rows: Tensor) -> Tensor:
        """The rows of all Gaussians, in each process."""
        size = self.ranks.size
        copies = torch.cat([rows.detach()] * size)
        return self.ranks.exchange(copies, [len(rows)] * size, self.counts)

    def whole(self, rows: Tensor) -> Tensor:
        """The rows of all Gaussians in the main memory of the first process; elsewhere none."""
        none = [0] * (self.ranks.size - 1)
        by = self.counts if self.ranks.first else [0, *none]
        return self.ranks.exchange(rows.detach().cpu(), [len(rows), *none], by)

    def own(self, rows: Tensor) -> Tensor:
        """This process' rows, of those of all Gaussians."""
        start = sum(self.counts[: self.ranks.rank])
        return rows[start : start + self.counts[self.ranks.rank]]


def part_of(model: Model, ranks: Ranks, device: torch.device | str) -> Model:
    """This process' share of a model's Gaussians, on a device: successive rows.

    The model must be the same in all processes.
    """
    start, end = (len(model) * rank // ranks.size for rank in (ranks.rank, ranks.rank + 1))
    rows = torch.arange(len(model), device=model.device)
    return model.keep((rows >= start) & (rows < end)).to(device)


def whole_of(model: Model, ranks: Ranks) -> Model:
    """The whole model, in the main memory of the first process, from everyone's part.

    Other processes get one without Gaussians. RanksError if another process is gone.
    """
    shards = Shards(ranks, len(model))
    rows: dict[str, Any] = {name: shards.whole(each) for name, each in model.tensors.items()}
    if any(ranks.gather(model.thresholds is not None)):
        store = model.thresholds or ThresholdStore(len(model), model.device)
        state = store.state_dict()
        parts = {k: shards.whole(each) for k, each in state.items() if isinstance(each, Tensor)}
        rows["thresholds"] = ThresholdStore(0)
        rows["thresholds"].load_state_dict(state | parts)
    return replace(model, **rows)
