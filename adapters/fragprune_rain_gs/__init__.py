"""KU-CVLAB/RAIN-GS: 3DGS from random or sparse points, coarse to fine.

While there are few Gaussians, its rasterizer dilates them widely (``low_pass``). During warm-up
every split also places a copy far away, so one split appends twice. In its newer mode the host sets
no learning rate before iteration 10,000, and an offset one afterwards.
"""

from __future__ import annotations

from argparse import ArgumentParser
from dataclasses import dataclass, replace
from pathlib import Path

from fragprune_3dgs_fork.holding import HoldingAdapter
from fragprune_graphdeco import GraphdecoAdapter, GraphdecoDialect, RasterizerCall
from fragprune_plugins.adapting import (
    HostCall,
    HostInfo,
    HostRepo,
    Photographs,
    RasterInputs,
    revised,
)

PACKAGE = "submodules.diff_gaussian_rasterization.diff_gaussian_rasterization"
"""Inside the checkout, and compiled when it is imported."""

WARM_UP = 10_000  # iterations that ``--ours_new`` warms up

SMALLER = {
    **dict.fromkeys(("bicycle", "flowers", "garden", "stump", "treehill"), "images_4"),
    **dict.fromkeys(("room", "counter", "kitchen", "bonsai"), "images_2"),
}
"""Scenes of Mip-NeRF 360: where the path holds one's name the host reads this folder's images;
where it holds several, that of the last."""


@dataclass(frozen=True)
class RainDialect(GraphdecoDialect):
    """Vanilla's call of 2023 with a dilation of its own, and depth."""

    own_kernels = "compiler"
    unneeded = {"wandb": {}}  # imported and never used
    returned = ("image", "radii", "depth")

    def unpack(self, call: HostCall) -> RasterInputs:
        """Translate the call."""
        return replace(super().unpack(call), dilation=float(call.settings.low_pass))


class RainGS(HoldingAdapter):
    """The adapter of RAIN-GS."""

    name = "rain-gs"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "RAIN-GS",
        repo="KU-CVLAB/RAIN-GS",
        states="2024, both of its modes",
        limits=("Stage 2 leaves out the modes (--ours, --ours_new, --c2f), which cannot resume.",),
    )
    package = PACKAGE
    calls = (RasterizerCall(frozenset({"low_pass"}), 3),)
    own_names = ("divide_ratio", "scene:args_dict", f"{PACKAGE}:GaussianRasterizer")
    dialect_type = RainDialect
    steps_by_rendering = True
    flags = {"white_background": ("--white_bg",), "hold_out": ()}  # it always holds views out
    seams = revised(GraphdecoAdapter.seams, {"GaussianRasterizer.forward": {"module": PACKAGE}})

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """The command without its modes, which cannot resume.

        If only ``--exp_name`` gives the output folder, the command names the folder.
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

    def densified(self, repo: HostRepo, script: Path, arguments: list[str]) -> int | None:
        """Later by the warm-up, which a mode of the host sets itself."""
        until = super().densified(repo, script, arguments)
        own = self.numbers(repo, script, arguments, ["warmup_iter"])
        warm_up = WARM_UP if "--ours_new" in arguments else max(own.get("warmup_iter", [0]))
        return None if until is None else until + warm_up

    def photographs(self, repo: HostRepo, arguments: list[str]) -> Photographs:
        """Vanilla's photographs, from the image folder that the scene's name implies."""
        read = super().photographs(repo, arguments)
        folders = [folder for name, folder in SMALLER.items() if name in str(read.folder)]
        return replace(read, images=folders[-1]) if folders else read
