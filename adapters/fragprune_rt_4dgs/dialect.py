"""The rasterizer call of RT-4DGS: a moment in, six pictures out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any

from fragprune_graphdeco import GraphdecoDialect
from fragprune_plugins.adapting import AlignmentError, HostCall, RasterInputs, RasterOutputs, Splats
from fragprune_plugins.slicing.splats import MARGINAL_MIN, Moment, Sliced, SpacetimeSplats

if TYPE_CHECKING:
    from torch import Tensor


RASTERIZER = "gaussian_renderer.diff_gaussian_rasterization"  # compiled at its import

SETTINGS = frozenset(
    ("sh_degree_t", "timestamp", "time_duration", "rot_4d", "gaussian_dim", "force_sh_3d")
)
"""Those that vanilla does not have."""

ARGUMENTS = frozenset(("flow_2d", "ts", "scales_t", "rotations_r", "prefilter_var"))
"""Likewise, of the call."""

OUTPUTS = 6

OLDER = (1.0, -1.0, 1.0, -1.0), (1.0, 1.0, -1.0, -1.0)
"""Signs of the left and the right quaternions that turn as those of 2024 did, with axes t, z, y, x:
a matrix of these that is read from its end is that of the same numbers with these signs.
"""


@dataclass(frozen=True)
class RT4DGSDialect(GraphdecoDialect):
    """Cuts the 4D Gaussians at the call's moment; an engine draws the 3D Gaussians."""

    older: bool = False
    """4D rotations have their axes in another order, as the host's had until late 2024."""
    own_kernels = "compiler"
    returned = ("image", "radii", "depth", "alpha", "flow")

    def features(self, call: HostCall) -> Tensor:
        """(N, 3) depth and flow."""
        import torch

        depths, flow = super().features(call), call.get("flow_2d")
        assert depths is not None  # it is returned
        flow = depths.new_zeros(len(depths), 2) if flow is None else flow
        return torch.cat([depths, flow], dim=1)

    def unpack(self, call: HostCall) -> RasterInputs:
        """Translate the call. Absent rows are at the camera.

        The host also drops a Gaussian whose integer radius is not above 0.4. With a dilation of 0.3
        pixels^2 no radius is below 3, so this drops only covariances that are not finite.
        """
        sliced = at_moment(call, self.older)
        flat = {
            "means3D": sliced.means,
            "means2D": call.get("means2D"),
            "flow_2d": call.get("flow_2d"),
            "opacities": sliced.opacities,
            "cov3D_precomp": sliced.cov3d,
            "colors_precomp": call["colors_precomp"] if sliced.colors is None else sliced.colors,
        }
        return super().unpack(HostCall(call.settings, flat))

    def rows_drawn(self, model: Any, call: HostCall) -> Tensor | None:
        """With ``compute_cov3D_python`` only rows present at the moment, by the host's own mask.

        The opacities of the call, which include the marginal, must be those of these rows.
        """
        import torch

        if call.get("cov3D_precomp") is None or model.gaussian_dim != 4:
            return None
        with torch.no_grad():
            marginal = model.get_marginal_t(call.settings.timestamp)
            rows: Tensor = (marginal[:, 0] > MARGINAL_MIN).nonzero()[:, 0]
            expected = (model.get_opacity * marginal)[rows]
        if not torch.equal(expected, call["opacities"]):
            where, found = "rt-4dgs: compute_cov3D_python", f"{len(call['opacities'])} Gaussians"
            expected = f"the {len(rows)} of {len(marginal)} that are present at "
            expected += f"{float(call.settings.timestamp):g}, with their opacities"
            remedy = "Report this with the host's commit, or leave compute_cov3D_python off."
            raise AlignmentError(where, found, expected, remedy)
        return rows

    def answer(
        self, call: HostCall, inputs: RasterInputs, draw: Callable[[RasterInputs], RasterOutputs]
    ) -> tuple[Tensor, ...]:
        """The result of ``pack``, and covs_com (P, 6): the drawn covariances, without gradients."""
        drawn = self.pack(draw(inputs), call)
        assert isinstance(inputs.splats, Splats)  # unpack made them
        assert inputs.splats.cov3d is not None
        return (*drawn, inputs.splats.cov3d.detach())

    def made(self, outputs: RasterOutputs, call: HostCall) -> dict[str, Any]:
        """Depth (1, H, W) and flow (2, H, W) have gradients."""
        features = outputs.features
        assert features is not None  # unpack asked for them
        return super().made(outputs, call) | {"depth": features[:1], "flow": features[1:]}

    def names(self) -> frozenset[str]:
        """The import names of vanilla's packages and of pointops2_cuda."""
        return super().names() | {"pointops2_cuda"}

    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """Stand-ins for the rasterizer, simple_knn and the neighbours of the rigidity loss."""
        from fragprune_graphdeco import stand_ins
        from fragprune_rt_4dgs.neighbours import knnquery

        neighbours = stand_ins.module("pointops2_cuda", knnquery_cuda=knnquery)
        return {**super().modules(draw), "pointops2_cuda": neighbours}


def at_moment(call: HostCall, older: bool = False) -> Sliced:
    """The Gaussians of a call as 3D Gaussians, by the host's code path for this call."""
    from fragprune_plugins.slicing.cutting import slice_at

    s, given = call.settings, {}
    in_time = s.gaussian_dim == 4 or s.rot_4d
    if call.get("cov3D_precomp") is not None:  # the host sliced, and left out absent rows
        given["cov3d"] = call["cov3D_precomp"]
    else:
        given |= {"scales": call["scales"], "rotations": call["rotations"]}
        if in_time:
            given["scales_t"] = call["scales_t"].reshape(-1)
        if s.rot_4d:
            given["rotations_r"] = call["rotations_r"]
        if s.rot_4d and older:
            for name, signs in zip(("rotations", "rotations_r"), OLDER, strict=True):
                given[name] = given[name] * given[name].new_tensor(signs)
    if in_time:
        given["times"] = call["ts"].reshape(-1)
    splats = SpacetimeSplats(
        means=call["means3D"],
        opacities=call["opacities"].reshape(-1),
        sh=call.get("shs"),
        sh_degree=int(s.sh_degree),
        **given,
    )
    timed = s.gaussian_dim == 4 and not s.force_sh_3d
    return slice_at(
        splats,
        Moment(
            timestamp=float(s.timestamp),
            campos=s.campos,
            duration=float(s.time_duration),
            sh_degree_t=int(s.sh_degree_t) if timed else None,
            prefilter_var=float(call.arguments.get("prefilter_var", -1.0)),
            scale_modifier=float(s.scale_modifier),
        ),
        engine=call.engine,
    )
