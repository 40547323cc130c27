"""VITA-Group/LightGaussian: prunes Gaussians by how much they are drawn, then distils their colour.

With ``f_count`` set, its rasterizer also returns the number of fragments that each Gaussian drew,
and a score that adds the Gaussian's opacity for each fragment. Pruning follows both. With
thresholds they count only fragments that remain after truncation, as in the shown picture.
"""

from __future__ import annotations

from argparse import ArgumentParser
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fragprune_3dgs_fork.holding import HoldingAdapter
from fragprune_graphdeco import GraphdecoAdapter, GraphdecoDialect, RasterizerCall, model_seam
from fragprune_plugins.adapting import HostCall, HostInfo, HostRepo, RasterOutputs, Role, Seam

TRAIN, PRUNE, DISTIL = "train_densify_prune.py", "prune_finetune.py", "distill_train.py"


@dataclass(frozen=True)
class LightGaussianDialect(GraphdecoDialect):
    """Vanilla's call of 2023, and its counting form."""

    def values(self, call: HostCall) -> tuple[str, ...]:
        """Colour and radii; in the counting form, which has no gradients, two more before them."""
        plain = super().values(call)
        return ("count", "score", *plain) if call.settings.f_count else plain

    def made(self, outputs: RasterOutputs, call: HostCall) -> dict[str, Any]:
        """Also the score (P,). The host adds a Gaussian's opacity once per fragment.

        The product of count and opacity is the same sum, rounded once.
        """
        made = super().made(outputs, call)
        if call.settings.f_count:
            made = {name: each.detach() for name, each in made.items() if each is not None}
            made["score"] = made["count"] * call["opacities"].detach().reshape(-1)
        return made


class LightGaussian(HoldingAdapter):
    """The adapter of LightGaussian."""

    name = "light-gaussian"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "LightGaussian",
        repo="VITA-Group/LightGaussian",
        states="2024, rasterizer of 240618b (score: opacity per fragment)",
        limits=(
            "VecTree and render.py --load_vq ignore thresholds: their pictures are untruncated.",
        ),
    )
    calls = (
        RasterizerCall(frozenset({"f_count"})),
        RasterizerCall(frozenset({"f_count"}), 4, "count_render"),
    )
    dialect_type = LightGaussianDialect
    scripts = (TRAIN, PRUNE, DISTIL)
    kept = ("onedownSHdegree",)
    flags = {"continues": (PRUNE, DISTIL)}
    optimizer = "AdamW"
    densifies_until = ("densify_until_iter", "prune_iterations")
    seams = (
        *GraphdecoAdapter.seams,
        Seam(Role.VIEW, "gaussian_renderer", "count_render", ("viewpoint_camera", "pc")),
        model_seam(Role.STILL, "prune_gaussians"),
        model_seam(Role.STILL, "prune_opacity"),
        model_seam(Role.STILL, "densify"),
        model_seam(Role.LOAD, "load_ply_sh", "path"),
    )

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """The command for stage 2. Distillation cannot resume: it would remove another SH band."""
        if script.name != DISTIL:
            return script, arguments
        parser = ArgumentParser(add_help=False)
        parser.add_argument("--new_max_sh", default="2")
        for flag in ("--teacher_model", "--opacity_prune"):
            parser.add_argument(flag)
        for flag in ("--augmented_view", "--enable_covariance", "--enable_opacity"):
            parser.add_argument(flag, action="store_true")
        own, shared = parser.parse_known_args(arguments)
        return script.with_name(TRAIN), [*shared, "--sh_degree", own.new_max_sh]

    def densified(self, repo: HostRepo, script: Path, arguments: list[str]) -> int | None:
        """The last pruning of a training; None for scripts that go on from a checkpoint."""
        return super().densified(repo, script, arguments) if script.name == TRAIN else None
