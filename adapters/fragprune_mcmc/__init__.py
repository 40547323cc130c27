"""ubc-vision/3dgs-mcmc: 3D Gaussian Splatting as Markov chain Monte Carlo.

Instead of cloning, splitting and pruning, the host overwrites its nearly transparent Gaussians with
copies of others (relocation), appends copies up to ``--cap_max``, and after every optimizer step
adds noise to the positions, scaled by the rate that ``update_learning_rate`` returns.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import fragprune_graphdeco as graphdeco
from fragprune_graphdeco import GraphdecoAdapter, GraphdecoDialect, RasterizerCall, model_seam
from fragprune_plugins.adapting import (
    AlignmentError,
    ConfigFile,
    HostInfo,
    Role,
    RowTrace,
    SeamCall,
    revised,
)

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class MCMCDialect(GraphdecoDialect):
    """Vanilla's call, with ``is_used`` as third output."""

    returned = ("image", "radii", "is_used")  # the last is passed on and never read


@contextmanager
def following_copies(call: SeamCall) -> Iterator[RowTrace]:
    """Note the parents that the host draws, whose copies overwrite dead rows or are appended.

    The host hands them to ``_update_params``, which makes the copies. It drops the moments of both.
    AlignmentError if the new rows are no copies.
    """
    import torch

    model, trace, drawn = call.model, RowTrace(), []
    before, update = len(model.get_xyz), model._update_params

    def noting(idxs: Tensor, *args: Any, **kwargs: Any) -> Any:
        drawn.append(idxs.detach().clone())
        return update(idxs, *args, **kwargs)

    model._update_params = noting
    try:
        yield trace
    finally:
        del model._update_params
    if not drawn:  # nothing to overwrite or to append
        return
    parents, dead = drawn[-1], call.arguments.get("dead_mask")
    origins = torch.arange(len(model.get_xyz), device=parents.device)
    rows = origins[before:].clone() if dead is None else dead.nonzero()[:, 0]
    colours, turns = model._features_dc.detach(), model._rotation.detach()
    if len(rows) != len(parents) or not all(
        torch.equal(each[rows], each[parents]) for each in (colours, turns)
    ):
        where = str(call.seam)
        found = f"{len(rows)} new rows that are not copies of the {len(parents)} sampled"
        remedy = "Report this with the host's commit: its relocation differs."
        raise AlignmentError(where, found, "one copy per sampled row, in the host's order", remedy)
    origins[rows] = parents
    trace.origins, trace.fresh = origins, torch.zeros_like(origins, dtype=torch.bool)
    trace.fresh[rows] = trace.fresh[parents] = True


class MCMC(GraphdecoAdapter):
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
        model_seam(Role.REARRANGE, "relocate_gs", "dead_mask", how=following_copies),
        model_seam(Role.REARRANGE, "add_new_gs", "cap_max", how=following_copies),
    )
