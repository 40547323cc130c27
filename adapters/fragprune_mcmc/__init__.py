"""ubc-vision/3dgs-mcmc: 3D Gaussian Splatting as Markov chain Monte Carlo.

Instead of cloning, splitting and pruning, the host overwrites its nearly transparent Gaussians with
copies of others (relocation), appends copies up to ``--cap_max``, and after every optimizer step
adds noise to the positions, scaled by the rate that ``update_learning_rate`` returns.
"""

from __future__ import annotations

from dataclasses import dataclass

import fragprune_graphdeco as graphdeco
from fragprune_3dgs_fork.holding import HoldingAdapter
from fragprune_graphdeco import GraphdecoAdapter, GraphdecoDialect, RasterizerCall, model_seam
from fragprune_plugins.adapting import ConfigFile, HostInfo, Role, revised


@dataclass(frozen=True)
class MCMCDialect(GraphdecoDialect):
    """Vanilla's call, with ``is_used`` as third output."""

    returned = ("image", "radii", "is_used")  # the last is passed on and never read


class MCMC(HoldingAdapter):
    """The adapter of 3DGS-MCMC."""

    name = "mcmc"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "3D Gaussian Splatting as Markov Chain Monte Carlo",
        repo="ubc-vision/3dgs-mcmc",
        states="January 2025",
        limits=(
            "Our engines clip at 3 sigma like the pinned rasterizer; branch gs-mcmc clips at 1.8.",
        ),
    )
    calls = (RasterizerCall(outputs=3),)
    own_names = ("utils.reloc_utils:compute_relocation",)
    dialect_type = MCMCDialect
    flags = {"config": ConfigFile("--config")}  # its values override the others
    seams = (
        *revised(
            GraphdecoAdapter.seams,
            {"GaussianModel.update_learning_rate": {"how": graphdeco.no_noise}},
        ),
        model_seam(Role.REARRANGE, "relocate_gs", "dead_mask"),
        model_seam(Role.REARRANGE, "add_new_gs", "cap_max"),
    )
