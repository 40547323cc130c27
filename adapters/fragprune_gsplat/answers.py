"""What we answer for functions of gsplat that need a GPU, where there is none."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from fragprune_graphdeco import stand_ins
from fragprune_gsplat.projection import covariances
from fragprune_plugins.adapting import EngineError, InputError, SeamCall

EPSILON = torch.finfo(torch.float32).eps


def relocation(call: SeamCall) -> Any:
    """Opacities (N,) and scales (N, 3) of Gaussians that share the place of one (3DGS-MCMC).

    Since 1.6 a new opacity has a bound from below before it gives the scales.
    """
    given = call.arguments
    if given["opacities"].is_cuda:
        return call.run()
    bounds = (given["min_opacity"], 1 - EPSILON) if "min_opacity" in given else (0.0, 1.0)
    n_max = len(given["binoms"])
    opacities, scales = stand_ins.compute_relocation(
        given["opacities"].reshape(-1),
        given["scales"],
        given["ratios"].clamp(1, n_max),
        None,
        n_max + 1,  # gsplat includes n_max
        bounds,
    )
    return opacities.view_as(given["opacities"]), scales.view_as(given["scales"])


def covariance(call: SeamCall) -> tuple[Tensor, None]:
    """Covariances (N, 3, 3) of quaternions and scales, and no precisions."""
    given = call.arguments
    if given["quats"].is_cuda:
        done: tuple[Tensor, None] = call.run()
        return done
    if given["compute_preci"] or given["triu"] or not given["compute_covar"]:
        where, found = "gsplat.quat_scale_to_covar_preci", "precisions or triangles asked for"
        expected = "covariances (N, 3, 3), as MCMCStrategy does"
        raise InputError(where, found, expected, "Compute these on a machine with a GPU.")
    return covariances(given["quats"], given["scales"]), None


def alone(call: SeamCall) -> Any:
    """Run a training in this process, which gsplat does on one GPU alone.

    EngineError for several GPUs: thresholds would be missing in gsplat's process for each.
    """
    given, count = call.arguments, torch.cuda.device_count()
    if count > 1:
        where, found = "gsplat.distributed.cli", f"{count} GPUs, and a process for each"
        raise EngineError(where, found, "one GPU", "Choose it: set CUDA_VISIBLE_DEVICES=0.")
    return call.run() if count else given["fn"](0, 0, 1, given["args"])
