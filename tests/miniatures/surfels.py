"""A miniature 2D Gaussian Splatting: the demo's host with what the method adds."""

from types import SimpleNamespace
from typing import Any

import torch

from miniatures.family import BACKWARD, MODEL, RADII, RENDERER, TRAIN, Derived, adding

MAPS = """

def surface(viewpoint_camera, allmap, pipe):
    alpha = allmap[1:2]
    turn = viewpoint_camera.world_view_transform[:3, :3].T
    normal = (allmap[2:5].permute(1, 2, 0) @ turn).permute(2, 0, 1)
    expected = torch.nan_to_num(allmap[0:1] / alpha, 0, 0)
    median = torch.nan_to_num(allmap[5:6], 0, 0)
    depth = expected * (1 - pipe.depth_ratio) + pipe.depth_ratio * median
    seen = depth_to_normal(viewpoint_camera, depth) * alpha.detach()
    return {
        "rend_alpha": alpha,
        "rend_normal": normal,
        "rend_dist": allmap[6:7],
        "surf_depth": depth,
        "surf_normal": seen,
    }
"""

POINTS = '''"""Normals of a depth map, as an orthographic camera would see them."""

import torch


def depth_to_normal(view, depth):
    """(3, H, W) unit normals of depths (1, H, W)."""
    down, across = torch.gradient(depth[0])
    facing = torch.stack([-across, -down, torch.ones_like(down)])
    return torch.nn.functional.normalize(facing, dim=0)
'''


class SurfelHost(Derived):
    """How to drive it: two scales, and losses of depths and normals."""

    options = {
        "Pipeline": {"depth_ratio": 0.0},
        "Optimization": {"lambda_dist": 100.0, "lambda_normal": 0.05},
    }
    changes = {
        RENDERER: [
            ("from diff_gaussian_rasterization import", "from diff_surfel_rasterization import"),
            adding(
                "from utils.sh_utils import eval_sh\n",
                before="from utils.point_utils import depth_to_normal\n",
            ),
            ("    image, radii = Gauss", "    image, radii, allmap = Gauss"),
            (
                f"{RADII}    }}\n",
                f"{RADII}    }} | surface(viewpoint_camera, allmap, pipe)\n{MAPS}",
            ),
        ],
        MODEL: [
            ("(scales)[:, None].repeat(1, 3)", "(scales)[:, None].repeat(1, 2)"),
            (
                "        offset = (turn @ torch.normal(torch.zeros_like(spread), spread)",
                "        flat = torch.nn.functional.pad(spread, (0, 1))\n"
                "        offset = (turn @ torch.normal(torch.zeros_like(flat), flat)",
            ),
        ],
        TRAIN: [
            adding(
                BACKWARD,
                before="        drawn, seen = package['rend_normal'], package['surf_normal']\n"
                "        error = 1 - (drawn * seen).sum(dim=0)\n"
                "        loss = loss + (opt.lambda_normal if iteration > 7 else 0) * error.mean()\n"
                "        far = package['rend_dist'].mean()\n"
                "        loss = loss + (opt.lambda_dist if iteration > 3 else 0) * far\n",
            )
        ],
    }
    files = {"utils/point_utils.py": POINTS}

    def fill(self, model: Any, cloud: Any) -> None:
        """With rotations that a seed tells: the host begins with any."""
        super().fill(model, cloud)
        generator = torch.Generator().manual_seed(len(cloud.points))
        with torch.no_grad():
            model._rotation.copy_(torch.randn(len(cloud.points), 4, generator=generator))

    def pipe(self) -> Any:
        """With the blend of expected and median depth."""
        return SimpleNamespace(**vars(super().pipe()), depth_ratio=0.4)
