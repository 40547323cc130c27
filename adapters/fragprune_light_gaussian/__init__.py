"""VITA-Group/LightGaussian: prunes Gaussians by how much they are drawn, then distils their colour.

Its rasterizer can count: with ``f_count`` set it also returns how many fragments each Gaussian drew
and a score that adds the Gaussian's opacity for each. Pruning follows these, so with thresholds
active they count what is left after truncation: the picture that is shown.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fragprune_plugins.adapting import (
    CommandLine,
    GraphdecoAdapter,
    GraphdecoDialect,
    HostAdapter,
    HostCall,
    HostInfo,
    HostRepo,
    RasterInputs,
    RasterizerCall,
    RasterOutputs,
    Role,
    Seam,
    hookimpl,
)

if TYPE_CHECKING:
    from torch import Tensor


MODEL = "scene.gaussian_model"
TRAIN, PRUNE, DISTIL = "train_densify_prune.py", "prune_finetune.py", "distill_train.py"


@dataclass(frozen=True)
class LightGaussianDialect(GraphdecoDialect):
    """Vanilla's call of 2023, and its counting form."""

    def unpack(self, call: HostCall) -> RasterInputs:
        """Counts are asked for where the host asks for them."""
        inputs = super().unpack(call)
        return inputs.with_counts() if call.settings.f_count else inputs

    def pack(self, outputs: RasterOutputs, call: HostCall) -> tuple[Tensor, ...]:
        """(colour (3, H, W), radii (P,)); counting, (count (P,) int32, score (P,)) before them.

        The counting form has no gradients. The host adds the opacity fragment by fragment; it is
        the same for all of a Gaussian's, so the product is that sum, rounded once.
        """
        drawn = super().pack(outputs, call)
        if not call.settings.f_count:
            return drawn
        count = outputs.fragments_per_gaussian
        assert count is not None  # unpack asked for it
        score = count * call["opacities"].detach().reshape(-1)
        return (count, score, *(tensor.detach() for tensor in drawn))


class LightGaussian(GraphdecoAdapter):
    """LightGaussian."""

    name = "light-gaussian"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "LightGaussian",
        repo="VITA-Group/LightGaussian",
        states="2024, rasterizer of 240618b (score: opacity per fragment)",
        limits=(
            "VecTree and render.py --load_vq know no thresholds: their pictures are untruncated.",
        ),
    )
    calls = (
        RasterizerCall(frozenset({"f_count"})),
        RasterizerCall(frozenset({"f_count"}), 4, "count_render"),
    )
    dialect_type = LightGaussianDialect
    scripts = (TRAIN, PRUNE, DISTIL)
    optimizer = "AdamW"
    seams = (
        *GraphdecoAdapter.seams,
        Seam(Role.VIEW, "gaussian_renderer", "count_render", ("viewpoint_camera", "pc")),
        Seam(Role.STILL, MODEL, "GaussianModel.prune_gaussians"),
        Seam(Role.STILL, MODEL, "GaussianModel.prune_opacity"),
        Seam(Role.STILL, MODEL, "GaussianModel.densify"),
        Seam(Role.LOAD, MODEL, "GaussianModel.load_ply_sh", ("path",)),
    )

    def command_line(self, repo: HostRepo) -> CommandLine:
        """Pruning and distillation are given a checkpoint to work on."""
        return replace(super().command_line(repo), continues=(PRUNE, DISTIL))

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """Distillation cannot go on from what it wrote: it would take another SH band away."""
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

    def view(self, camera: Any) -> int:
        """Distillation draws through copies of its cameras; they keep their number."""
        return int(getattr(camera, "uid", id(camera)))


@hookimpl
def fragprune_register_adapters(register: Callable[[HostAdapter], None]) -> None:
    """Offer LightGaussian."""
    register(LightGaussian())
