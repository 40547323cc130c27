import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer

from scene.gaussian_model import GaussianModel


def render(viewpoint_camera, pc: GaussianModel, pipe, bg_color, scaling_modifier=1.0):
    rasterizer = GaussianRasterizer(
        raster_settings=GaussianRasterizationSettings(
            tanfovx=math.tan(viewpoint_camera.FoVx * 0.5), bg=bg_color, debug=pipe.debug
        )
    )
    image, radii = rasterizer(means3D=pc.get_xyz, opacities=pc.get_opacity, shs=pc.get_features)
    return {"render": image, "visibility_filter": (radii > 0).nonzero(), "radii": radii}
