"""ASU-ESIC-FAN-Lab/LP-3DGS: learns a pruning mask over an importance score, for several models.

Which model and score it trains with is chosen by ``--prune_method``. Its rasterizer always returns
four values, the last two None unless a setting asks for a score.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from fragprune_graphdeco import GraphdecoAdapter, GraphdecoDialect, RasterizerCall
from fragprune_plugins.adapting import (
    EngineError,
    HostCall,
    HostInfo,
    HostRepo,
    RasterInputs,
    Role,
    Seam,
    SeamCall,
    UsageError,
)

SCORES = ("f_count", "bw_score", "mw_score", "top_K_dT")
MINI, RAD = "scene.gaussian_model_mini_splatting", "scene.gaussian_model_rad_splat"
NO_METRICS = dict.fromkeys(("SSIM", "PSNR", "LPIPS"), math.nan)


def _nothing(*_: Any, **__: Any) -> None:
    """Accept any arguments and do nothing."""


NO_SWEEP = SimpleNamespace(sweep_id=None)
SILENT = {"wandb": {"init": lambda **_: NO_SWEEP, "define_metric": _nothing, "log": _nothing}}
"""A wandb that records nothing."""


@dataclass(frozen=True)
class LP3DGSDialect(GraphdecoDialect):
    """Vanilla's call of 2023, and its form that sums blending weights."""

    unneeded = SILENT

    def unpack(self, call: HostCall) -> RasterInputs:
        """Translate the call; EngineError if the host wants another score."""
        foreign = [n for n in SCORES if n != "bw_score" and getattr(call.settings, n)]
        if foreign:
            found = f"{foreign[0]}, which RadSplat's pruning follows"
            expected = "bw_score or none: our engines compute no other"
            remedy = "Train with the host's own rasterizer and start from what it saved with "
            remedy += "--stage finetune."
            raise EngineError("the rasterizer's scores", found, expected, remedy)
        return super().unpack(call)

    def values(self, call: HostCall) -> tuple[str, ...]:
        """The picture, radii, None, and the blending weights if the host wants them."""
        return ("image", "radii", "", "weight" if call.settings.bw_score else "")


def nothing_rendered(call: SeamCall) -> dict[str, float]:
    """Skip the rendering of iteration 30,000 at the script's end; stage 2 has none."""
    return dict.fromkeys(("train", "test"), math.nan)


def nothing_measured(call: SeamCall) -> dict[str, Any]:
    """Skip the evaluation of iteration 30,000 at the script's end."""
    return {path: {"ours_30000": NO_METRICS} for path in call.first}


class LP3DGS(GraphdecoAdapter):
    """The adapter of LP-3DGS."""

    name = "lp-3dgs"
    drawn_from = ("get_opacity_and_scales_for_train",)
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "LP-3DGS",
        repo="ASU-ESIC-FAN-Lab/LP-3DGS",
        states="2024; prune methods 3dgs, mini_splatting, rad_splat",
        limits=(
            "--prune_method compact_3dgs: its model has groups of its own and is refused.",
            "--prune_method rad_splat: pruning needs the host's own rasterizer; stage 2 does not.",
            "After a training of other than 30,000 iterations the host saves, then ends in a "
            "KeyError: the run says so, and goes on to stage 2.",
        ),
    )
    calls = (RasterizerCall(frozenset(SCORES), None),)
    dialect_type = LP3DGSDialect
    seams = (
        *GraphdecoAdapter.seams,
        *(
            Seam(Role.STILL, module, f"{model}.{method}")
            for module, model, method in (
                (MINI, "MiniSplatting", "prune_after_render"),
                (MINI, "MiniSplatting", "oneupSHdegree"),
                (RAD, "RadSplat", "prune_after_render"),
            )
        ),
        Seam(Role.STILL, "render", "render_sets", how=nothing_rendered),
        Seam(Role.STILL, "metrics", "evaluate", ("model_paths",), how=nothing_measured),
        Seam(Role.METRIC, "lpipsPyTorch", "lpips"),
    )

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """The same script; UsageError for the prune method with a model of its own."""
        if "compact_3dgs" in arguments or "--prune_method=compact_3dgs" in arguments:
            where = "--prune_method compact_3dgs"
            found = "a model with a mask among its parameters, and a resume that fails in the host"
            expected = "3dgs, mini_splatting or rad_splat"
            raise UsageError(where, found, expected, "Fine-tune its PLY with fragprune finetune.")
        return script, arguments

    def densified(self, repo: HostRepo, script: Path, arguments: list[str]) -> int | None:
        """The end of densification, or of the learning of masks, after which the host prunes."""
        names = ("prune_iterations", "train_mask_iters")
        masks = self.numbers(repo, script, arguments, names)
        ends = [sum(map(max, masks.values())), super().densified(repo, script, arguments) or 0]
        return max(ends) or None

    def model_of(self, call: SeamCall) -> Any:
        """The model; None for the functions that the script calls at its end."""
        return self if call.instance is None else call.instance
