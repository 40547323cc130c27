"""fudan-zvg/4d-gaussian-splatting (RT-4DGS): Gaussians in space and time.

A view is drawn at a moment. The Gaussians are cut at that moment, and the resulting 3D Gaussians
are splatted as usual. A threshold acts on the falloff of the 3D Gaussian; the likelihood of the
moment only scales its opacity. The host has no PLY: its checkpoints are its models, and carry the
thresholds.
"""

from __future__ import annotations

import re
from argparse import ArgumentParser
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fragprune_graphdeco import MODEL, GraphdecoAdapter, RasterizerCall, kernels, text_of
from fragprune_plugins.adapting import (
    Finding,
    HostInfo,
    HostRepo,
    ParamGroup,
    SeamCall,
    UsageError,
    revised,
)
from fragprune_rt_4dgs.config import YAMLFile
from fragprune_rt_4dgs.dialect import ARGUMENTS, OUTPUTS, RASTERIZER, SETTINGS, RT4DGSDialect

if TYPE_CHECKING:
    from torch import Tensor

ROTATIONS = "utils.general_utils"  # where the host makes 4D rotations


_OLDER = re.compile(r"a,-b,-c,-d,b,a,-d,c,c,d,a,-b,d,-c,b,a")
"""A kernel's left quaternion as a matrix, before late 2024."""


def turns_as_before(repo: HostRepo) -> bool:
    """Whether 4D rotations do not have their axes turned round, as they do since late 2024."""
    texts = [text_of(repo.tree(each)) for each in (MODEL, ROTATIONS)]
    return not any(map(re.compile(r"\bflip\([^()]*1, 2").search, texts))


def with_its_map(call: SeamCall) -> Any:
    """Keep the environment map: the training loop replaces it by a new one."""
    call.model.restored_env_map = call.first[17] if len(call.first) > 17 else None
    return call.first


def with_a_gradient_of_times(call: SeamCall) -> Any:
    """Give the moments a gradient, which the host reads in every iteration, also while frozen."""
    moments = call.model._t
    if moments.grad is None:
        moments.grad = moments.new_zeros(moments.shape)
    return call.result


class RT4DGS(GraphdecoAdapter):
    """The adapter of RT-4DGS, with and without 4D rotation."""

    name = "rt-4dgs"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "RT-4DGS",
        repo="fudan-zvg/4d-gaussian-splatting",
        states="January 2026",
        limits=(
            "gaussian_dim 3 cannot be resumed: --stage finetune --from-iter N learns in one run.",
            "It has no PLY: fragprune finetune, render, compare and export have nothing to read.",
        ),
    )
    package = RASTERIZER
    calls = (RasterizerCall(SETTINGS, OUTPUTS, arguments=ARGUMENTS),)
    groups = (*GraphdecoAdapter.groups, *map(ParamGroup, ("t", "scaling_t", "rotation_r")))
    drawn_from = (
        *("get_current_covariance_and_mean_offset", "get_marginal_t"),
        *("active_sh_degree_t", "get_t", "time_duration"),
    )
    own_names = ("get_marginal_t", f"{RASTERIZER}:GaussianRasterizer")
    dialect_type = RT4DGSDialect
    flags = {
        "save_checkpoints": "--save_iterations",
        "config": YAMLFile("--config"),
        "checkpoints_only": True,
        "skipped": 2,  # iterations start at 2, and the last one takes no step
    }
    resumes_ply = False
    beside = ("env_map_optimizer",)
    undrawn = (
        "checkpoints of Gaussians in time for models, and no PLY",
        "Read the PSNR that the host prints at its test_iterations.",
    )
    seams = revised(
        GraphdecoAdapter.seams,
        {
            "GaussianRasterizer.forward": {"module": RASTERIZER},
            "GaussianModel.update_learning_rate": {"how": with_a_gradient_of_times},
            "GaussianModel.restore": {"how": with_its_map},
            "GaussianModel.save_ply": None,
            "GaussianModel.load_ply": None,
        },
    )

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """Also that its Python turns 4D rotations as a vendored kernel does."""
        found, texts = super().fingerprint(repo), kernels.normal_sources(repo, RASTERIZER)
        older = any(map(_OLDER.search, texts))
        if texts and older != turns_as_before(repo):
            at, says = (
                repo.place(ROTATIONS, "build_rotation_4d"),
                "other 4D rotations than its kernel",
            )
            found.append(Finding.error("rotations", at, says, "the same"))
        return found

    def dialect(self, repo: HostRepo) -> RT4DGSDialect:
        """Also with the order of axes in 4D rotations."""
        made = super().dialect(repo)
        older = turns_as_before(repo)
        return RT4DGSDialect(made.package, made.settings, made.outputs, older=older)

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """The same command, if the host can resume this configuration."""
        parser = ArgumentParser(add_help=False)
        parser.add_argument("--config", type=Path)
        parser.add_argument("--gaussian_dim", type=int, default=3)
        flags, _ = parser.parse_known_args(arguments)
        if flags.config is None:  # the host cannot do without, and says so
            return script, arguments
        values = vars(flags) | YAMLFile("--config").read(flags.config)
        if values["gaussian_dim"] != 4:
            found = (
                f"{values['gaussian_dim']}: the host fails to resume its own checkpoints of these"
            )
            remedy = "Learn inside one run, with fragprune run --stage finetune --from-iter N."
            raise UsageError("gaussian_dim", found, "4", remedy)
        return script, arguments

    def extra_parameters(self, model: Any) -> list[Tensor]:
        """The environment map, whose optimizer is a local of the training loop."""
        return [model.env_map] if getattr(model.env_map, "requires_grad", False) else []

    def prepare_stage2(self, model: Any, start: Path | None) -> None:
        """Restore the environment map, which the host replaced by a new black one."""
        import torch

        saved = getattr(model, "restored_env_map", None)
        if saved is not None and model.env_map is not None and not model.env_map.any():
            with torch.no_grad():
                model.env_map.copy_(saved)

    def model_file(self, output: Path, iteration: int) -> Path:
        """The path to which ``scene.save`` writes."""
        return output / f"chkpnt{iteration}.pth"

    def save_model(self, model: Any, output: Path, iteration: int) -> Path:
        """Save the model as ``scene.save`` does."""
        import torch

        path = self.model_file(output, iteration)
        torch.save((model.capture(), iteration), path)
        return path
