"""Draws one view of the model."""

import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer
from scene.gaussian_model import GaussianModel
from utils.sh_utils import eval_sh


def render(
    viewpoint_camera,
    pc: GaussianModel,
    pipe,
    bg_color: torch.Tensor,
    scaling_modifier=1.0,
    override_color=None,
):
    """Draw the Gaussians.

    Returns:
        A dict: "render" (3, H, W), "viewspace_points" (N, 3) whose gradient is the screen's,
        "visibility_filter" (N,) bool and "radii" (N,) int, pixels.
    """
    screenspace = torch.zeros_like(pc.get_xyz, requires_grad=True) + 0
    if screenspace.requires_grad:
        screenspace.retain_grad()
    settings = GaussianRasterizationSettings(
        image_height=int(viewpoint_camera.image_height),
        image_width=int(viewpoint_camera.image_width),
        tanfovx=math.tan(viewpoint_camera.FoVx / 2),
        tanfovy=math.tan(viewpoint_camera.FoVy / 2),
        bg=bg_color,
        scale_modifier=scaling_modifier,
        viewmatrix=viewpoint_camera.world_view_transform,
        projmatrix=viewpoint_camera.full_proj_transform,
        sh_degree=pc.active_sh_degree,
        campos=viewpoint_camera.camera_center,
        prefiltered=False,
        debug=pipe.debug,
    )
    shape = {"scales": None, "rotations": None, "cov3D_precomp": None}
    if pipe.compute_cov3D_python:
        shape["cov3D_precomp"] = pc.get_covariance(scaling_modifier)
    else:
        shape.update(scales=pc.get_scaling, rotations=pc.get_rotation)
    look = {"shs": None, "colors_precomp": override_color}
    if override_color is None and pipe.convert_SHs_python:
        toward = torch.nn.functional.normalize(pc.get_xyz - viewpoint_camera.camera_center)
        colours = eval_sh(pc.active_sh_degree, pc.get_features.transpose(1, 2), toward)
        look["colors_precomp"] = torch.clamp_min(colours + 0.5, 0.0)
    elif override_color is None:
        look["shs"] = pc.get_features
    image, radii = GaussianRasterizer(raster_settings=settings)(
        means3D=pc.get_xyz, means2D=screenspace, opacities=pc.get_opacity, **shape, **look
    )
    return {
        "render": image,
        "viewspace_points": screenspace,
        "visibility_filter": radii > 0,
        "radii": radii,
    }
