"""The rasterizer call of RT-4DGS: a moment in, six pictures out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import ModuleType
from typing import TYPE_CHECKING, Any

from fragprune_plugins.adapter import HostCall
from fragprune_plugins.lineage import GraphdecoDialect

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.types import RasterInputs, RasterOutputs
    from fragprune_rt_4dgs.slice4d import Moment

RASTERIZER = "gaussian_renderer.diff_gaussian_rasterization"
"""A file of the host, compiled when it is imported."""

SETTINGS = frozenset(
    ("sh_degree_t", "timestamp", "time_duration", "rot_4d", "gaussian_dim", "force_sh_3d")
)
"""Those that vanilla does not have."""

OUTPUTS = 6


@dataclass(frozen=True)
class RT4DGSDialect(GraphdecoDialect):
    """Slices the 4D Gaussians at the call's moment, in torch; an engine draws what is left."""

    def unpack(self, call: HostCall) -> RasterInputs:
        """Depth and optical flow become features; rows that are not there go behind the camera.

        The host also drops a Gaussian whose integer radius is not above 0.4. With 0.3 pixels^2 of
        dilation no radius is below 3, so only a covariance that is not finite is meant.
        """
        import torch

        s, moment = call.settings, at_moment(call)
        there = (moment.present & moment.cov3d.isfinite().all(dim=1))[:, None]
        means = torch.where(there, moment.means, s.campos)
        flat = {
            "means3D": means,
            "means2D": call.get("means2D"),
            "opacities": moment.opacities,
            "cov3D_precomp": moment.cov3d,
            "colors_precomp": _colors(call, moment),
        }
        inputs = super().unpack(HostCall(s, flat))
        depths = means @ s.viewmatrix[:3, 2:3] + s.viewmatrix[3, 2]
        flow = call.get("flow_2d")
        flow = means.new_zeros(len(means), 2) if flow is None else flow
        features = torch.cat([depths, flow], dim=1)
        return replace(inputs, splats=replace(inputs.splats, features=features))

    def answer(
        self, call: HostCall, inputs: RasterInputs, draw: Callable[[RasterInputs], RasterOutputs]
    ) -> tuple[Tensor, ...]:
        """What ``pack`` gives, and covs_com (P, 6): the covariances drawn, without gradients."""
        from fragprune_plugins.types import Splats

        drawn = self.pack(draw(inputs), call)
        assert isinstance(inputs.splats, Splats)  # unpack made them
        assert inputs.splats.cov3d is not None
        return (*drawn, inputs.splats.cov3d.detach())

    def pack(self, outputs: RasterOutputs, call: HostCall) -> tuple[Tensor, ...]:
        """(colour (3, H, W), radii (P,), depth (1, H, W), alpha (1, H, W), flow (2, H, W))."""
        features = outputs.features
        assert features is not None  # unpack asked for them
        return outputs.image, outputs.radii, features[:1], outputs.alpha, features[1:]

    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """Stand-ins for the rasterizer, simple_knn and the neighbours of the rigidity loss."""
        from fragprune_rt_4dgs import neighbours

        return {**super().modules(draw), **neighbours.modules()}


def at_moment(call: HostCall) -> Moment:
    """The Gaussians of a call as 3D Gaussians, by whichever of the host's paths it asks for."""
    import torch

    from fragprune_rt_4dgs import slice4d

    s, means = call.settings, call["means3D"]
    opacities = call["opacities"].reshape(-1)
    given = call.get("cov3D_precomp")
    if given is not None:  # the host sliced them itself, in Python, and left out who is not there
        everyone = torch.ones_like(opacities, dtype=torch.bool)
        return slice4d.Moment(means, given, opacities, everyone)
    scales, turns = call["scales"] * s.scale_modifier, call["rotations"]
    if s.gaussian_dim == 3 and not s.rot_4d:
        everyone = torch.ones_like(opacities, dtype=torch.bool)
        cov3d = slice4d.upper(slice4d.covariance(slice4d.rotation(turns), scales))
        return slice4d.Moment(means, cov3d, opacities, everyone)
    times = call["ts"].reshape(-1)
    scales = torch.cat([scales, call["scales_t"].reshape(-1, 1) * s.scale_modifier], dim=1)
    variance = float(call.arguments.get("prefilter_var", -1.0))
    when = {"timestamp": float(s.timestamp), "prefilter_var": variance}
    if s.rot_4d:
        both = turns, call["rotations_r"]
        return slice4d.joint(means, opacities, times, scales, both, **when)
    return slice4d.separate(means, opacities, times, scales, turns, **when)


def _colors(call: HostCall, moment: Moment) -> Tensor:
    """(N, 3) RGB: the host's, or from its harmonics, with or without time."""
    from fragprune_rt_4dgs.color4d import Clock, colors

    s, sh = call.settings, call.get("shs")
    if sh is None:
        return call["colors_precomp"]
    clock = None
    if s.gaussian_dim == 4 and not s.force_sh_3d:
        times, duration = call["ts"].reshape(-1), float(s.time_duration)
        clock = Clock(times, float(s.timestamp), duration, int(s.sh_degree_t))
    return colors(sh, call["means3D"], moment.means, s.campos, int(s.sh_degree), clock)
