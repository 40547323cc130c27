"""maincold2/Compact-3DGS: a learned mask, colours from a hash grid, shapes from codebooks.

Its checkpoints lack the mask and the colour network, so nothing can resume them: stage 2 is the
later part of one run (``--from-iter``). What it saves is activated already, and in part beside the
PLY: our own readers refuse it, and the host's own draws it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from fragprune_plugins.errors import NotComparedError, UsageError
from fragprune_plugins.hosts.adapter import HostAdapter, HostInfo, RowTrace
from fragprune_plugins.hosts.graphdeco import GraphdecoAdapter
from fragprune_plugins.hosts.seams import Role, Seam, revised
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.plugins.hookspecs import hookimpl

if TYPE_CHECKING:
    from torch import Tensor

MODEL = "scene.gaussian_model"
NETWORK = "network"
"""Our name for the param group of the hash grid and the colour network, which has none."""
ENDINGS = {"save_npz": (".npz",), "save_npz_pp": ("_pp.npz",), "load_model": ("_pp.npz", ".npz")}


class Compact3DGS(GraphdecoAdapter):
    """Compact-3DGS."""

    name = "compact-3dgs"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "Compact 3D Gaussian Representation",
        repo="maincold2/Compact-3DGS",
        states="September 2024",
        limits=(
            "Its checkpoints cannot be resumed: --stage finetune --from-iter N learns in one run.",
            "It needs tinycudann, and that a GPU; nothing of ours stands in for it.",
            "fragprune finetune, render and compare refuse its files: values are activated and the "
            "colours are not in them.",
        ),
    )
    groups = ("xyz", "opacity", "scaling", "rotation", "mask")
    own_names = tuple(f"{MODEL}:{name}" for name in ("vq_scale", "recolor", "mlp_head"))
    seams = (
        *revised(GraphdecoAdapter.seams, {"GaussianModel.load_ply": None}),
        Seam(Role.LOAD, MODEL, "GaussianModel.load_model", ("path",)),
        Seam(Role.SAVE, MODEL, "GaussianModel.save_npz", ("path",)),
        Seam(Role.SAVE, MODEL, "GaussianModel.save_npz_pp", ("path",)),
        Seam(Role.STILL, MODEL, "GaussianModel.mask_prune"),
        Seam(Role.REARRANGE, MODEL, "GaussianModel.sort_morton"),
    )

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """Nothing can.

        Raises:
            UsageError: always.
        """
        raise UsageError(
            "stage 2 of Compact-3DGS",
            "checkpoints without its mask and its colour network: the host cannot resume them",
            "--stage finetune --from-iter N and --iterations N + 5000 of one run",
            "Add --from-iter with the iteration that training should end at.",
        )

    def drawing(self, repo: HostRepo, arguments: list[str]) -> NoReturn:
        """Not by us: its colours are a network's."""
        raise NotComparedError(
            "Compact-3DGS",
            "models whose colours are a network's and not in the file",
            "models that our own readers draw",
            "Draw and measure with the host's render.py and metrics.py.",
        )

    def optimizers(self, model: Any, arguments: Mapping[str, Any]) -> list[Any]:
        """The Gaussians', then the hash grid's and the colour network's."""
        return [model.optimizer, model.optimizer_net]

    def group_name(self, model: Any, group: Mapping[str, Any]) -> str | None:
        """The network's group has no name of the host's."""
        return str(group.get("name", NETWORK))

    def trained_groups(self, train: str) -> frozenset[str] | None:
        """opacity, or with the colours' network; None for all."""
        groups = {"opacity": {"opacity"}, "appearance": {"opacity", NETWORK}}.get(train)
        return frozenset(groups) if groups else None

    def prepare_stage2(self, model: Any, output: Path | None) -> None:
        """Codebooks that are in use learn in the forward pass; they stop, as at the host's end."""
        for codebooks in (model.vq_scale, model.vq_rot):
            for layer in codebooks.layers:
                if bool(layer._codebook.initted):
                    layer.training = False

    def check_children(self, model: Any, tensors: Mapping[str, Tensor], parents: Tensor) -> bool:
        """Clones and split children carry their parent's rotation and opacity bit for bit."""
        import torch

        return torch.equal(tensors["rotation"], model._rotation[parents]) and torch.equal(
            tensors["opacity"], model._opacity[parents]
        )

    @contextmanager
    def tracing(
        self, model: Any, wrapped: Callable[..., Any], arguments: Mapping[str, Any]
    ) -> Iterator[RowTrace]:
        """Row numbers ride along as a second column of the opacities, which sorting only moves.

        The bits of an integer, not its value: every row number is exact.
        """
        import torch

        opacity, trace = model._opacity.detach(), RowTrace()
        numbers = torch.arange(len(opacity), dtype=torch.int32, device=opacity.device)
        rider = numbers.view(torch.float32)[:, None]
        model._opacity = torch.nn.Parameter(torch.cat([opacity, rider], dim=1))
        try:
            yield trace
        finally:
            opacity, rider = (part.contiguous() for part in model._opacity.detach().split(1, 1))
            model._opacity = torch.nn.Parameter(opacity)
        trace.origins = rider[:, 0].view(torch.int32).long()
        trace.fresh = torch.zeros_like(trace.origins, dtype=torch.bool)

    def file_at(self, method: str, path: Path) -> Path:
        """The host leaves endings out; it loads the most compressed file there is."""
        named = [path.with_name(path.name + ending) for ending in ENDINGS.get(method, ())]
        if method == "load_model":
            ply = path.with_name(f"{path.name}.ply")
            return next((file for file in named if file.is_file()), ply)
        return named[0] if named else path


@hookimpl
def fragprune_register_adapters(register: Callable[[HostAdapter], None]) -> None:
    """Offer Compact-3DGS."""
    register(Compact3DGS())
