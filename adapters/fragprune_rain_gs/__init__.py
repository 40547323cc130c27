"""KU-CVLAB/RAIN-GS: 3DGS from random or sparse points, coarse to fine.

While Gaussians are few its rasterizer dilates them widely (``low_pass``), and while it warms up
every split also throws a copy far out, so one split appends twice. In its newer mode the host sets
no learning rate before iteration 10,000 and an offset one from there.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from fragprune_plugins.adapting import (
    CommandLine,
    GraphdecoAdapter,
    GraphdecoDialect,
    HostAdapter,
    HostCall,
    HostInfo,
    HostRepo,
    Photographs,
    RasterInputs,
    RasterizerCall,
    RasterOutputs,
    SeamCall,
    graphdeco,
    hookimpl,
    revised,
)

if TYPE_CHECKING:
    from torch import Tensor


MODEL = "scene.gaussian_model"
PACKAGE = "submodules.diff_gaussian_rasterization.diff_gaussian_rasterization"
"""Inside the checkout, and compiled when it is imported."""

SMALLER = {
    **dict.fromkeys(("bicycle", "flowers", "garden", "stump", "treehill"), "images_4"),
    **dict.fromkeys(("room", "counter", "kitchen", "bonsai"), "images_2"),
}
"""Scenes of Mip-NeRF 360: where the path holds one's name the host reads this folder's images;
where it holds several, that of the last."""


@dataclass(frozen=True)
class RainDialect(GraphdecoDialect):
    """Vanilla's call of 2023 with a dilation of its own, and depth as third output."""

    def unpack(self, call: HostCall) -> RasterInputs:
        """Depth is blended as one more channel; it has no gradient."""
        inputs = super().unpack(call)
        view = inputs.view.viewmatrix
        depth = call["means3D"].detach() @ view[:3, 2:3] + view[3, 2]
        splats = replace(inputs.splats, features=depth)
        return replace(inputs, splats=splats, dilation=float(call.settings.low_pass))

    def pack(self, outputs: RasterOutputs, call: HostCall) -> tuple[Tensor, ...]:
        """(colour (3, H, W), radii (P,) int32, depth (1, H, W): the sum of z alpha T)."""
        assert outputs.features is not None  # unpack asked for it
        return outputs.image, outputs.radii, outputs.features.detach()

    def spares(self) -> dict[str, ModuleType]:
        """``train.py`` imports wandb and does not use it."""
        return {"wandb": ModuleType("wandb", "Stand-in of fragprune: empty.")}


def far_splits(call: SeamCall) -> Tensor:
    """A far split appends N - 1 copies of each row before it appends N children."""
    children = call.arguments["N"]
    far = call.arguments["abe_split"]
    return graphdeco.splits(call, copies=2 * children - 1 if far else children)


class RainGS(GraphdecoAdapter):
    """RAIN-GS."""

    name = "rain-gs"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "RAIN-GS",
        repo="KU-CVLAB/RAIN-GS",
        states="2024, both of its modes",
        limits=("Stage 2 leaves its modes out (--ours, --ours_new, --c2f): they cannot resume.",),
    )
    package = PACKAGE
    calls = (RasterizerCall(frozenset({"low_pass"}), 3),)
    own_names = (f"{MODEL}:divide_ratio", "scene:args_dict", f"{PACKAGE}:GaussianRasterizer")
    dialect_type = RainDialect
    steps_by_rendering = True
    seams = revised(
        GraphdecoAdapter.seams,
        {
            "GaussianRasterizer.forward": {"module": PACKAGE},
            graphdeco.SPLIT.attribute: {
                "needs": (*graphdeco.SPLIT.needs, "abe_split"),
                "how": far_splits,
            },
        },
    )

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """Without its modes, which cannot resume: they replace the points and set no dilation.

        Where only ``--exp_name`` says where the output is, the folder is named.
        """
        parser = ArgumentParser(add_help=False, allow_abbrev=False)
        for flag in ("--ours", "--ours_new", "--paper_random", "--c2f"):
            parser.add_argument(flag, action="store_true")
        for flag in ("--train_from", "--warmup_iter", "--num_gaussians"):
            parser.add_argument(flag)
        rest = parser.parse_known_args(arguments)[1]
        parser.add_argument("-m", "--model_path")
        parser.add_argument("--exp_name")
        flags, _ = parser.parse_known_args(arguments)
        if flags.exp_name and not flags.model_path:
            rest += ["-m", str(Path("output") / flags.exp_name)]
        return script, rest

    def command_line(self, repo: HostRepo) -> CommandLine:
        """Vanilla's, but for its own white; views are always held out."""
        line = super().command_line(repo)
        return replace(line, white_background=("--white_bg",), hold_out=())

    def photographs(self, repo: HostRepo, arguments: list[str]) -> Photographs:
        """Vanilla's, from the folder that the scene's name stands for."""
        read = super().photographs(repo, arguments)
        folders = [folder for name, folder in SMALLER.items() if name in str(read.folder)]
        return replace(read, images=folders[-1]) if folders else read


@hookimpl
def fragprune_register_adapters(register: Callable[[HostAdapter], None]) -> None:
    """Offer RAIN-GS."""
    register(RainGS())
