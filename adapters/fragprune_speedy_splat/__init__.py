"""j-alex-hanson/speedy-splat: prunes Gaussians by squared gradients, draws them in exact tiles.

Its pruning score is a sum over a Gaussian's fragments of the squared gradient by the falloff. The
host's rasterizer returns it as a gradient. Our engines do not compute it, so stage 1 with pruning
needs the host's own rasterizer. Stage 2 does not prune and needs no score.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fragprune_3dgs_fork.holding import HoldingAdapter
from fragprune_graphdeco import GraphdecoAdapter, GraphdecoDialect, RasterizerCall, model_seam
from fragprune_plugins.adapting import (
    EngineError,
    HostCall,
    HostInfo,
    RasterInputs,
    RasterOutputs,
    Role,
    Seam,
)

UNTIL = "--prune_until_iter"


@dataclass(frozen=True)
class SpeedySplatDialect(GraphdecoDialect):
    """Vanilla's call of 2023 with a tensor for scores, and the time taken as third output."""

    otherwise = "it draws beyond three sigma, and returns a time"

    def unpack(self, call: HostCall) -> RasterInputs:
        """Translate the call; EngineError before pruning: scores of 0 would prune all."""
        scores = call.get("scores")
        if scores is not None and scores.requires_grad:
            found = "a pruning pass of Speedy-Splat, which needs squared gradients per fragment"
            expected = "pictures only: our engines do not compute that score"
            remedy = "Train with the host's own rasterizer and start from what it saved with "
            remedy += f"--stage finetune; or give {UNTIL} 0 to train without pruning."
            raise EngineError("the rasterizer's scores", found, expected, remedy)
        return super().unpack(call)

    def answer(
        self, call: HostCall, inputs: RasterInputs, draw: Callable[[RasterInputs], RasterOutputs]
    ) -> Any:
        """(colour (3, H, W), radii (P,), milliseconds (1,)). The host divides by the time."""
        import torch

        begun = time.perf_counter()
        outputs = draw(inputs)
        if outputs.image.is_cuda:
            torch.cuda.synchronize()
        took = torch.tensor([(time.perf_counter() - begun) * 1e3])
        return outputs.image, outputs.radii, took


class SpeedySplat(HoldingAdapter):
    """The adapter of Speedy-Splat."""

    name = "speedy-splat"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "Speedy-Splat",
        repo="j-alex-hanson/speedy-splat",
        states="December 2024",
        limits=(
            "Its pruning needs the host's own rasterizer and so a GPU; stage 2 does not.",
            "Our engines clip to the tiles of three sigma, as vanilla does; the host's own "
            "rasterizer also draws fragments beyond, of an alpha below 0.0111.",
        ),
    )
    calls = (RasterizerCall(outputs=3, arguments=frozenset({"scores"})),)
    own_names = ("gaussian_renderer:kernel_times",)
    dialect_type = SpeedySplatDialect
    densifies_until = ("densify_until_iter", "prune_until_iter")
    seams = (
        *GraphdecoAdapter.seams,
        model_seam(Role.STILL, "prune_gaussians"),
        Seam(Role.METRIC, "lpipsPyTorch", "lpips"),
    )

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """The same script without pruning, so that it computes no scores."""
        return script, [*arguments, UNTIL, "0"]
