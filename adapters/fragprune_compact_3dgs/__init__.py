"""maincold2/Compact-3DGS: a learned mask, colours from a hash grid, shapes from codebooks.

Its checkpoints lack the mask and the colour network, so nothing can resume them. Stage 2 is the
later part of one run (``--from-iter``). Its files hold activated values and keep the colours
outside the PLY. Our readers refuse them; the host's own scripts draw them.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from fragprune_graphdeco import GraphdecoAdapter, model_seam
from fragprune_plugins.adapting import HostInfo, ParamGroup, Role, SeamCall, UsageError, revised

SORTED = ("xyz", "opacity", "scaling", "rotation")
NETWORK = "network"  # our name for the param group of hash grid and colour network
PP = "_pp.npz"  # ends the name of a file whose attributes are coded further


def ended(call: SeamCall, by: str) -> Path:
    """The file's path with the ending, which the host leaves out."""
    path = Path(call.first)
    return path.with_name(path.name + by)


def most_compressed(call: SeamCall) -> Path:
    """The most compressed existing file, which is the one that the host loads."""
    files = [ended(call, ending) for ending in (PP, ".npz", ".ply")]
    return next((file for file in files if file.is_file()), files[-1])


def rows(call: SeamCall) -> dict[str, Any]:
    """What sorting moves: the model's own values, and its optimizer keeps the former ones."""
    return {name: getattr(call.model, f"_{name}") for name in SORTED}


class Compact3DGS(GraphdecoAdapter):
    """The adapter of Compact-3DGS."""

    name = "compact-3dgs"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "Compact 3D Gaussian Representation",
        repo="maincold2/Compact-3DGS",
        states="September 2024",
        limits=(
            "Its checkpoints cannot be resumed: --stage finetune --from-iter N learns in one run.",
            "It needs tinycudann, which needs a GPU; we have no stand-in for it.",
            "fragprune finetune, render and compare refuse its files, which hold activated values "
            "and no colours.",
        ),
    )
    groups = (
        GraphdecoAdapter.groups[0],
        ParamGroup("opacity", copied=True),
        ParamGroup("scaling"),
        ParamGroup("rotation", copied=True),
        ParamGroup("mask"),
        ParamGroup(NETWORK, colour=True, named=False),
    )
    undrawn = (
        "models whose colours are a network's and not in the file",
        "Draw and measure with the host's render.py and metrics.py.",
    )
    densifies_until = ()  # it prunes by its mask to the end
    drawn_from = (
        *("_mask", "_feature", "mlp_head", "recolor"),
        *("contract_to_unisphere", "direction_encoding"),
    )
    own_names = ("vq_scale", "recolor", "mlp_head")
    seams = (
        *revised(GraphdecoAdapter.seams, {"GaussianModel.load_ply": None}),
        model_seam(Role.LOAD, "load_model", "path", how=most_compressed),
        model_seam(Role.SAVE, "save_npz", "path", how=partial(ended, by=".npz")),
        model_seam(Role.SAVE, "save_npz_pp", "path", how=partial(ended, by=PP)),
        model_seam(Role.STILL, "mask_prune"),
        model_seam(Role.REARRANGE, "sort_morton", how=rows),
    )

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """Refuse: no command can resume this host's training."""
        found = "checkpoints without its mask and its colour network: the host cannot resume them"
        expected = "--stage finetune --from-iter N and --iterations N + 5000 of one run"
        remedy = "Add --from-iter with the iteration that training should end at."
        raise UsageError("stage 2 of Compact-3DGS", found, expected, remedy)

    def group_name(self, model: Any, group: Mapping[str, Any]) -> str | None:
        """The group's name; the network's group has none in the host, so it gets ours."""
        return str(group.get("name", NETWORK))

    def prepare_stage2(self, model: Any, start: Path | None) -> None:
        """Stop the codebooks in use, which learn in the forward pass, as the host does too."""
        for codebooks in (model.vq_scale, model.vq_rot):
            for layer in codebooks.layers:
                if bool(layer._codebook.initted):
                    layer.training = False
