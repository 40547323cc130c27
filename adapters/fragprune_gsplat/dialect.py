"""The call of gsplat's ``rasterization``, which draws any number of cameras."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from fragprune_graphdeco import stand_ins
from fragprune_gsplat.projection import (
    TILE,
    Projection,
    Rules,
    basis,
    covariances,
    product,
    project,
)
from fragprune_plugins.adapting import (
    Dialect,
    Footprints,
    HostCall,
    InputError,
    RasterInputs,
    RasterOutputs,
    View,
)

BACKEND = "gsplat.cuda._backend"
MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
ONLY: dict[str, tuple[Any, ...]] = {
    "camera_model": ("pinhole",),
    "render_mode": MODES,
    "tile_size": (None, TILE),
    "distributed": (False,),
    "with_ut": (False,),
    "with_eval3d": (False,),
    "return_normals": (False,),
    "global_z_order": (True,),
    **dict.fromkeys(
        (
            *("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs"),
            *("lidar_coeffs", "external_distortion_coeffs", "rays", "viewmats_rs"),
            *("ut_params", "extra_signals", "renderer_config"),
        ),
        (None,),
    ),
}
"""What we draw; the argument's other values are refused by name."""
MAX_DEGREE = 3


@dataclass(frozen=True)
class Cameras(RasterInputs):
    """The inputs of the first camera, with those of the other cameras and all projections."""

    others: tuple[RasterInputs, ...] = ()
    projections: tuple[Projection, ...] = ()
    shown: Tensor | None = None
    """(C, N, 2) the projected means, or (nnz, 2) in packed calls; strategies read their gradients.
    """


@dataclass(frozen=True)
class GsplatDialect(Dialect):
    """The dialect of ``rasterization`` in one version."""

    means = "means"
    own_kernels = "gpu"
    alpha_max: float  # the cap on alpha; gradients are zero where it applies
    floor: float  # least antialiasing factor
    tight: bool  # radii are per axis and follow opacity; otherwise ``meta`` has one for both axes

    def unpack(self, call: HostCall) -> Cameras:
        """Project for every camera; the engine then only blends."""
        given = call.arguments
        self._refuse(call)
        means, count = given["means"], len(given["viewmats"])
        rules = Rules(
            eps2d=given["eps2d"],
            near=given["near_plane"],
            far=given["far_plane"],
            radius_clip=given["radius_clip"],
            antialiased=given["rasterize_mode"] == "antialiased",
            floor=self.floor,
            tight=self.tight,
        )
        covars = given["covars"]
        covars = covariances(given["quats"], given["scales"]) if covars is None else covars
        size = given["width"], given["height"]
        projections = tuple(
            project(means, covars, given["opacities"], viewmat, K, *size, rules)
            for viewmat, K in zip(given["viewmats"], given["Ks"], strict=True)
        )
        means2d = torch.stack([each.means2d for each in projections])
        shown = means2d
        if given["packed"]:  # strategies take the gradients of visible rows alone
            where = torch.stack([each.visible for each in projections]).nonzero(as_tuple=True)
            shown = means2d[where]
            means2d = torch.zeros_like(means2d).index_put(where, shown)
        drawn = [self._inputs(call, k, projections[k], means2d[k]) for k in range(count)]
        first = {field.name: getattr(drawn[0], field.name) for field in fields(RasterInputs)}
        return Cameras(**first, others=tuple(drawn[1:]), projections=projections, shown=shown)

    def _inputs(
        self, call: HostCall, k: int, projection: Projection, means2d: Tensor
    ) -> RasterInputs:
        given = call.arguments
        shown = given["backgrounds"] is not None and self._coloured(call)
        depth = "D" in given["render_mode"]
        viewmat, K = given["viewmats"][k].detach(), given["Ks"][k].detach()
        return RasterInputs(
            view=View.pinhole(
                viewmat[:3, :3],
                viewmat[:3, 3],
                width=given["width"],
                height=given["height"],
                **{name: float(K[at]) for name, at in _INTRINSICS.items()},
                background=given["backgrounds"][k] if shown else None,
            ),
            splats=Footprints(
                means2d=means2d - 0.5,
                conics=projection.conics,
                depths=projection.depths,
                opacities=projection.opacities,
                colors=self._colors(call, k),
                tiles=projection.tiles,
                features=projection.depths[:, None] if depth else None,
            ),
            alpha_max=self.alpha_max,
            cap_gradient=False,
            planes=("alpha",),
        )

    @staticmethod
    def _coloured(call: HostCall) -> bool:
        return "RGB" in str(call.arguments["render_mode"])

    def _colors(self, call: HostCall, k: int) -> Tensor:
        """(N, 3) of one camera; SH are evaluated as gsplat does, half a unit added, not below 0."""
        given = call.arguments
        means, degree = given["means"], given["sh_degree"]
        colors: Tensor = given["colors"]
        if not self._coloured(call):
            return torch.zeros_like(means)
        if colors.ndim == (3 if degree is None else 4):
            colors = colors[k]
        if degree is None:
            return colors
        campos = torch.linalg.inv(given["viewmats"][k])[:3, 3]
        directions = torch.nn.functional.normalize(means - campos, dim=-1)
        harmonics = basis(directions, degree)
        used = colors[:, : harmonics.shape[1]]
        return (product(harmonics[:, None], used)[:, 0] + 0.5).clamp_min(0)

    @staticmethod
    def _refuse(call: HostCall) -> None:
        """Raise an error that names an argument which we do not support."""
        given = call.arguments
        for name, known in ONLY.items():
            value = given.get(name, known[0])
            if not any(value is each or value == each for each in known):
                where = f"gsplat.rasterization({name}=)"
                remedy = "Draw this without thresholds: with fragprune_plugins.paused(): ..."
                raise InputError(where, repr(value)[:60], " or ".join(map(repr, known)), remedy)
        degree, colors = given["sh_degree"], given["colors"]
        trains = torch.is_grad_enabled() and given["means"].requires_grad and not call.still
        absolute = "False until stage 2: our engines sum it over both axes"
        checks = (
            ("means", given["means"].ndim == 2, "(N, 3), no batches in front"),
            ("colors", colors is None or colors.shape[-1] == 3, "three channels"),
            ("sh_degree", degree is None or degree <= MAX_DEGREE, f"at most {MAX_DEGREE}"),
            ("absgrad", not (given["absgrad"] and trains), absolute),
        )
        for name, holds, expected in checks:
            if not holds:
                where = f"gsplat.rasterization({name}=)"
                raise InputError(where, "another", expected, "Change the call.")

    def answer(
        self, call: HostCall, inputs: RasterInputs, draw: Callable[..., RasterOutputs]
    ) -> Any:
        """Draw one camera after another, each by the model's rules."""
        assert isinstance(inputs, Cameras)
        others = (replace(each, stop=inputs.stop, rim=inputs.rim) for each in inputs.others)
        drawn = [draw(each, part) for part, each in enumerate((inputs, *others))]
        return self._pack(drawn, inputs, call)

    def _pack(self, drawn: list[RasterOutputs], inputs: Cameras, call: HostCall) -> Any:
        """(colors (C, H, W, X), alphas (C, H, W, 1), meta); X by ``render_mode``."""
        given = call.arguments
        mode = given["render_mode"]
        alphas = torch.stack([each.alpha for each in drawn]).permute(0, 2, 3, 1)
        channels = [torch.stack([each.image for each in drawn])] if self._coloured(call) else []
        if "D" in mode:
            depths = torch.stack([d for each in drawn if (d := each.features) is not None])
            weight = alphas.permute(0, 3, 1, 2).clamp_min(1e-10) if "ED" in mode else 1.0
            channels.append(depths / weight)
        colors = torch.cat(channels, dim=1).permute(0, 2, 3, 1)
        return colors, alphas, self._meta(inputs, call)

    def _meta(self, inputs: Cameras, call: HostCall) -> dict[str, Any]:
        """The entries that strategies read, without the intersection lists of gsplat's kernels."""
        given = call.arguments
        stacked = {
            name: torch.stack([getattr(each, name) for each in inputs.projections])
            for name in ("radii", "depths", "conics", "opacities")
        }
        if not self.tight:
            stacked["radii"] = stacked["radii"][..., 0]
        camera = row = batch = None
        if given["packed"]:
            visible = torch.stack([each.visible for each in inputs.projections])
            camera, row = visible.nonzero(as_tuple=True)
            batch = torch.zeros_like(camera)
            stacked = {name: values[camera, row] for name, values in stacked.items()}
        return {
            "batch_ids": batch,
            "camera_ids": camera,
            "gaussian_ids": row,
            "means2d": inputs.shown,
            **stacked,
            "width": given["width"],
            "height": given["height"],
            "tile_size": TILE,
            "tile_width": math.ceil(given["width"] / TILE),
            "tile_height": math.ceil(given["height"] / TILE),
            "n_batches": 1,
            "n_cameras": len(inputs.projections),
        }

    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """A stand-in that keeps gsplat from compiling its kernels; ``answers`` has what we need."""
        return {BACKEND: stand_ins.module(BACKEND, _C=None)}


_INTRINSICS = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
