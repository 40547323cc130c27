"""ubc-vision/3dgs-mcmc: 3D Gaussian Splatting as Markov chain Monte Carlo.

Instead of cloning, splitting and pruning, the host overwrites its nearly transparent Gaussians with
copies of others (relocation), appends copies up to ``--cap_max``, and after every optimizer step
adds noise to the positions, scaled by the rate that ``update_learning_rate`` returns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import ModuleType
from typing import TYPE_CHECKING, Any

from fragprune_plugins.hosts.adapter import CommandLine, ConfigFile, HostAdapter, HostCall, HostInfo
from fragprune_plugins.hosts.graphdeco import GraphdecoAdapter, GraphdecoDialect, RasterizerCall
from fragprune_plugins.hosts.seams import Role, Seam
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.plugins.hookspecs import hookimpl

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.types import RasterOutputs

MODEL = "scene.gaussian_model"


@dataclass(frozen=True)
class MCMCDialect(GraphdecoDialect):
    """Vanilla's call, with ``is_used`` as third output and the relocation formula beside it."""

    def pack(self, outputs: RasterOutputs, call: HostCall) -> tuple[Tensor, ...]:
        """(colour (3, H, W), radii (P,) int32, is_used (P,) int32).

        The host hands ``is_used`` on and never reads it: here it says "on screen", an upper bound
        of its own rasterizer's "reached a pixel".
        """
        return outputs.image, outputs.radii, (outputs.radii > 0).to(outputs.radii)

    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """The lineage's stand-ins; the host imports the relocation from the rasterizer's."""
        from fragprune_plugins.hosts.graphdeco.stand_ins import compute_relocation

        modules = super().modules(draw)
        vars(modules[self.package])["compute_relocation"] = compute_relocation
        return modules


class MCMC(GraphdecoAdapter):
    """3DGS-MCMC."""

    name = "mcmc"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "3D Gaussian Splatting as Markov Chain Monte Carlo",
        repo="ubc-vision/3dgs-mcmc",
        states="January 2025",
        limits=(
            "Ours clips at 3 sigma, as the rasterizer it pins; that one's branch gs-mcmc at 1.8.",
        ),
    )
    calls = (RasterizerCall(outputs=3),)
    own_names = ("utils.reloc_utils:compute_relocation",)
    dialect_type = MCMCDialect
    seams = (
        *GraphdecoAdapter.seams,
        Seam(Role.CHOICE, MODEL, "GaussianModel._update_params", ("idxs", "ratio")),
        Seam(Role.COPY, MODEL, "GaussianModel.relocate_gs", ("dead_mask",)),
        Seam(Role.FORGET, MODEL, "GaussianModel.replace_tensors_to_optimizer", ("inds",)),
        Seam(Role.STILL, MODEL, "GaussianModel.add_new_gs", ("cap_max",)),
    )

    def command_line(self, repo: HostRepo) -> CommandLine:
        """The lineage's, and a configuration file whose values win over the flags."""
        return replace(super().command_line(repo), config=ConfigFile("--config"))

    def still_rate(self, rate: Any) -> float:
        """No rate, no noise: the host multiplies what it adds to the positions by it."""
        return 0.0


@hookimpl
def fragprune_register_adapters(register: Callable[[HostAdapter], None]) -> None:
    """Offer 3DGS-MCMC."""
    register(MCMC())
