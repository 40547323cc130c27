"""Adapters with one fault each, which the conformance kit must find."""

from dataclasses import replace
from typing import Any

import torch

from fragprune_gaussian_splatting import GaussianSplatting
from fragprune_graphdeco import GraphdecoDialect
from fragprune_graphdeco.adapter import completed
from fragprune_plugins.adapting import CHECKPOINT_KEY, revised
from fragprune_plugins.hosts.findings import Match
from fragprune_vanilla_3dgs import Vanilla3DGS


class PatchesByHand(Vanilla3DGS):
    """Wraps a function of the host by itself, and never takes it back."""

    def means(self, model: Any) -> torch.Tensor:
        kind = type(model)
        if not hasattr(kind.oneupSHdegree, "by_hand"):

            def wrapper(model: Any, original: Any = kind.oneupSHdegree) -> None:
                original(model)

            wrapper.by_hand = True
            kind.oneupSHdegree = wrapper
        return super().means(model)


class TakesRandomNumbers(Vanilla3DGS):
    def means(self, model: Any) -> torch.Tensor:
        torch.rand(1)
        return super().means(model)


class LosesParents(Vanilla3DGS):
    """Names no group by which the parents of children are known."""

    groups = tuple(replace(group, copied=False) for group in Vanilla3DGS.groups)


def without_thresholds(call: Any) -> Any:
    def rest(part: Any) -> Any:
        if not isinstance(part, dict):
            return part
        return {key: value for key, value in part.items() if key != CHECKPOINT_KEY}

    return tuple(map(rest, completed(call)))


class LosesTheCheckpoint(Vanilla3DGS):
    """Takes thresholds out of the host's checkpoint, and drops them."""

    seams = revised(Vanilla3DGS.seams, {"GaussianModel.restore": {"how": without_thresholds}})


class TrainsTooMuch(Vanilla3DGS):
    """Lets scales move with the opacities."""

    def group_name(self, model: Any, group: Any) -> str | None:
        name = super().group_name(model, group)
        return "opacity" if name == "scaling" else name


class LeavesParametersAsleep(Vanilla3DGS):
    """Freezes by a mark on the host's own parameters, and the host pickles it."""

    def prepare_stage2(self, model: Any, output: Any) -> None:
        model._scaling.requires_grad_(False)


class LeavesItsRates(Vanilla3DGS):
    """Sets a rate of stage 2 in the host's optimizer for good."""

    def prepare_stage2(self, model: Any, output: Any) -> None:
        model.optimizer.param_groups[3]["lr"] = 1e-3


class LetsItGrow(Vanilla3DGS):
    seams = revised(Vanilla3DGS.seams, {"GaussianModel.densify_and_prune": None})


class LetsItReset(Vanilla3DGS):
    seams = revised(Vanilla3DGS.seams, {"GaussianModel.reset_opacity": None})


class SavesNothing(Vanilla3DGS):
    """Does not know where the host saves."""

    seams = revised(
        Vanilla3DGS.seams,
        {"GaussianModel.save_ply": {"attribute": "GaussianModel.oneupSHdegree", "needs": ()}},
    )


class ReadsNoSource(Vanilla3DGS):
    """Takes any call of the rasterizer for the one it answers."""

    def fingerprint(self, repo: Any) -> list[Any]:
        return []


class FitsEverything(Vanilla3DGS):
    def match(self, repo: Any) -> Match:
        return Match(self.name, True)


def drawing(dialect: type[GraphdecoDialect]) -> type[Vanilla3DGS]:
    """The adapter whose host is drawn so."""
    members = {"dialect_type": dialect, "__module__": __name__}
    return type(dialect.__name__, (Vanilla3DGS,), members)


@drawing
class LeavesATrace(GraphdecoDialect):
    """Every Gaussian lights up all that is drawn, drawn or not."""

    def pack(self, outputs: Any, call: Any) -> Any:
        image, *rest = super().pack(outputs, call)
        drawn = image - call.settings.bg[:, None, None]
        return image + call["opacities"].mean() * drawn, *rest


@drawing
class DrawsOtherwiseEachTime(GraphdecoDialect):
    """No two pictures agree, whatever draws them: another dilation for every call."""

    calls = [0]  # noqa: RUF012 - counts through all instances

    def unpack(self, call: Any) -> Any:
        self.calls[0] += 1
        return replace(super().unpack(call), dilation=0.3 + 0.05 * self.calls[0])


@drawing
class ForgetsTheBackground(GraphdecoDialect):
    """Draws over black, whatever was asked for."""

    def unpack(self, call: Any) -> Any:
        inputs = super().unpack(call)
        return replace(inputs, view=replace(inputs.view, background=torch.zeros(3)))


@drawing
class GivesNoRadii(GraphdecoDialect):
    def pack(self, outputs: Any, call: Any) -> Any:
        return super().pack(replace(outputs, radii=torch.zeros_like(outputs.radii)), call)


class HoldsStepsBack(GaussianSplatting):
    """Holds back the step in which opacities would be reset, and the thresholds' with it."""

    seams = revised(GaussianSplatting.seams, {"OpacityResetter.optim_step": {"how": None}})
