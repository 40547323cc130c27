"""A miniature 2D Gaussian Splatting: the demo's host with what the method adds."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from fragprune_plugins.testing.host import Host
from fragprune_plugins.testing.rewriting import rewrite

MAPS = """

def surface(viewpoint_camera, allmap, pipe):
    alpha = allmap[1:2]
    turn = viewpoint_camera.world_view_transform[:3, :3].T
    normal = (allmap[2:5].permute(1, 2, 0) @ turn).permute(2, 0, 1)
    expected = torch.nan_to_num(allmap[0:1] / alpha, 0, 0)
    median = torch.nan_to_num(allmap[5:6], 0, 0)
    depth = expected * (1 - pipe.depth_ratio) + pipe.depth_ratio * median
    seen = depth_to_normal(viewpoint_camera, depth).permute(2, 0, 1) * alpha.detach()
    return {
        "rend_alpha": alpha,
        "rend_normal": normal,
        "rend_dist": allmap[6:7],
        "surf_depth": depth,
        "surf_normal": seen,
    }
"""

POINTS = '''"""Normals of a depth map."""

import math

import torch


def depth_to_normal(view, depth):
    """(H, W, 3) world normals of depths (1, H, W), zeros at the border."""
    _, height, width = depth.shape
    tan_x, tan_y = math.tan(view.FoVx / 2), math.tan(view.FoVy / 2)
    x = torch.arange(width, device="cuda") / width * 2 - 1
    y = torch.arange(height, device="cuda") / height * 2 - 1
    rows, columns = torch.meshgrid(y * tan_y, x * tan_x, indexing="ij")
    rays = torch.stack([columns, rows, torch.ones_like(rows)], dim=-1)
    points = depth[0, :, :, None] * (rays @ view.world_view_transform[:3, :3].T)
    across = points[2:, 1:-1] - points[:-2, 1:-1]
    down = points[1:-1, 2:] - points[1:-1, :-2]
    normal = torch.nn.functional.normalize(torch.cross(across, down, dim=-1), dim=-1)
    return torch.nn.functional.pad(normal, (0, 0, 1, 1, 1, 1))
'''

CHANGES = {
    "arguments/__init__.py": [
        (
            "        self.debug = False\n",
            "        self.debug = False\n        self.depth_ratio = 0.0\n",
        ),
        (
            "        self.lambda_dssim = 0.2\n",
            "        self.lambda_dssim = 0.2\n"
            "        self.lambda_dist = 100.0\n"
            "        self.lambda_normal = 0.05\n",
        ),
    ],
    "gaussian_renderer/__init__.py": [
        ("from diff_gaussian_rasterization import", "from diff_surfel_rasterization import"),
        (
            "from utils.sh_utils import eval_sh\n",
            "from utils.point_utils import depth_to_normal\nfrom utils.sh_utils import eval_sh\n",
        ),
        ("    image, radii = Gauss", "    image, radii, allmap = Gauss"),
        (
            '        "radii": radii,\n    }\n',
            '        "radii": radii,\n    } | surface(viewpoint_camera, allmap, pipe)\n' + MAPS,
        ),
    ],
    "scene/gaussian_model.py": [
        ("(scales)[:, None].repeat(1, 3)", "(scales)[:, None].repeat(1, 2)"),
        (
            "        offset = (turn @ torch.normal(torch.zeros_like(spread), spread)",
            "        flat = torch.nn.functional.pad(spread, (0, 1))\n"
            "        offset = (turn @ torch.normal(torch.zeros_like(flat), flat)",
        ),
    ],
    "train.py": [
        (
            "        loss.backward()\n",
            "        error = 1 - (package['rend_normal'] * package['surf_normal']).sum(dim=0)\n"
            "        loss = loss + (opt.lambda_normal if iteration > 7 else 0) * error.mean()\n"
            "        far = package['rend_dist'].mean()\n"
            "        loss = loss + (opt.lambda_dist if iteration > 3 else 0) * far\n"
            "        loss.backward()\n",
        )
    ],
}


class SurfelHost(Host):
    """How to drive it: two scales, and losses of depths and normals."""

    def write(self, root: Path) -> None:
        """The demo's host, changed where 2D Gaussian Splatting is otherwise."""
        super().write(root)
        rewrite(root, CHANGES)
        (root / "utils" / "point_utils.py").write_text(POINTS)

    def fill(self, model: Any, cloud: Any) -> None:
        """With rotations that a seed tells: the host begins with any."""
        super().fill(model, cloud)
        generator = torch.Generator().manual_seed(len(cloud.points))
        with torch.no_grad():
            model._rotation.copy_(torch.randn(len(cloud.points), 4, generator=generator))

    def pipe(self) -> Any:
        """With the blend of expected and median depth."""
        return SimpleNamespace(**vars(super().pipe()), depth_ratio=0.4)
