"""A miniature Mip-Splatting: the demo's host with what the method adds, from its interface."""

import copy
import math
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.recfunctions import append_fields
from plyfile import PlyData, PlyElement

from miniatures.family import MODEL, RENDERER, STEP, TRAIN, Derived, adding


class Added:
    @property
    def get_scaling_with_3D_filter(self):  # noqa: N802 - the name callers use
        return torch.sqrt(self.get_scaling.square() + self.filter_3D.square())

    @property
    def get_opacity_with_3D_filter(self):  # noqa: N802 - the name callers use
        return self.get_opacity * self._dimming()

    def _dimming(self):
        ratio = self.get_scaling / self.get_scaling_with_3D_filter
        return ratio.prod(dim=1, keepdim=True)

    @torch.no_grad()
    def compute_3D_filter(self, cameras):  # noqa: N802 - the name callers use
        nearest = torch.full((len(self._xyz),), math.inf, device="cuda")
        for camera in cameras:
            view = camera.world_view_transform
            depth = (self._xyz @ view[:3, :3] + view[3, :3])[:, 2].clamp_min(0.2)
            focal = camera.image_width / (2 * math.tan(camera.FoVx / 2))
            nearest = torch.minimum(nearest, depth / focal)
        self.filter_3D = (nearest * math.sqrt(0.2))[:, None]

    def _reset_statistics(self):
        self.vanilla_reset_statistics()
        self.xyz_gradient_accum_abs = torch.zeros_like(self.denom)

    def prune_points(self, mask):
        self.vanilla_prune_points(mask)
        self.xyz_gradient_accum_abs = self.xyz_gradient_accum_abs[~mask]

    def add_densification_stats(self, viewspace_point_tensor, update_filter):
        self.vanilla_add_densification_stats(viewspace_point_tensor, update_filter)
        grad = viewspace_point_tensor.grad[update_filter]
        self.xyz_gradient_accum_abs[update_filter] += grad[:, 2:].norm(dim=1, keepdim=True)

    def _needy(self, grads, grad_threshold, scene_extent, large):
        moved = self.vanilla_needy(grads, grad_threshold, scene_extent, large)
        return moved | self.vanilla_needy(*self._absolute, scene_extent, large)

    def densify_and_clone(self, grads, grad_threshold, grads_abs, grad_abs_threshold, scene_extent):
        self._absolute = grads_abs, grad_abs_threshold
        self.vanilla_densify_and_clone(grads, grad_threshold, scene_extent)

    def densify_and_split(
        self, grads, grad_threshold, grads_abs, grad_abs_threshold, scene_extent, N=2
    ):
        self._absolute = grads_abs, grad_abs_threshold
        self.vanilla_densify_and_split(grads, grad_threshold, scene_extent, N)

    def reset_opacity(self):
        low = self.get_opacity_with_3D_filter.clamp_max(0.01) / self._dimming()
        new = inverse_sigmoid(low.detach())  # noqa: F821
        self._opacity = self.replace_tensor_to_optimizer(new, "opacity")["opacity"]

    def save_ply(self, path):
        self.vanilla_save_ply(path)
        filters = self.filter_3D.cpu().numpy()[:, 0]
        rows = append_fields(PlyData.read(path)["vertex"].data, "filter_3D", filters, usemask=False)
        PlyData([PlyElement.describe(rows, "vertex")]).write(path)

    def save_fused_ply(self, path):
        fused = copy.copy(self)
        fused._opacity = inverse_sigmoid(self.get_opacity_with_3D_filter)  # noqa: F821
        fused._scaling = self.get_scaling_with_3D_filter.log()
        fused.vanilla_save_ply(path)

    def load_ply(self, path):
        self.vanilla_load_ply(path)
        column = np.asarray(PlyData.read(path)["vertex"]["filter_3D"])[:, None]
        self.filter_3D = torch.tensor(column, dtype=torch.float, device="cuda")


QUANTILE = """        grads_abs = (self.xyz_gradient_accum_abs / self.denom).nan_to_num(0.0)
        share = (grads >= max_grad).float().mean()
        quantile = torch.quantile(grads_abs.reshape(-1), 1 - share)
"""
ABSOLUTE = "grads_abs, quantile"
FILTER = "gaussians.compute_3D_filter(cameras=scene.getTrainCameras())\n"
FUSE = """import sys
from pathlib import Path

from arguments import ModelParams, get_combined_args
from argparse import ArgumentParser
from gaussian_renderer import GaussianModel

parser = ArgumentParser()
model = ModelParams(parser, sentinel=True)
parser.add_argument("--output_ply", default="./output.ply")
args = get_combined_args(parser)
gaussians = GaussianModel(model.extract(args).sh_degree)
newest = max(Path(args.model_path).glob("point_cloud/*/*.ply"), key=lambda p: p.stat().st_mtime)
gaussians.load_ply(str(newest))
gaussians.save_fused_ply(args.output_ply)
"""


class MipHost(Derived):
    """How to drive it: filters are as old as the last rows they were computed for."""

    options = {"Loading": {"_kernel_size": 0.1, "ray_jitter": False}}
    settings = {"subpixel_offset": None}
    changes = {
        RENDERER: [
            adding("    bg_color: torch.Tensor,\n", after="    kernel_size: float,\n"),
            adding("        bg=bg_color,\n", before="        kernel_size=kernel_size,\n"),
            adding(
                "    settings = Gauss",
                before="    if subpixel_offset is None:\n"
                "        size = viewpoint_camera.image_height, viewpoint_camera.image_width, 2\n"
                '        subpixel_offset = torch.zeros(size, device="cuda")\n',
            ),
            ("scales=pc.get_scaling,", "scales=pc.get_scaling_with_3D_filter,"),
            ("opacities=pc.get_opacity,", "opacities=pc.get_opacity_with_3D_filter,"),
        ],
        MODEL: [
            adding(
                "import numpy as np\n",
                before="import copy\nimport math\n\n",
                after="from numpy.lib.recfunctions import append_fields\n",
            ),
            adding("        self.densify_and_clone(grads, max", before=QUANTILE),
            *(
                (f"{way}(grads, max_grad, extent)", f"{way}(grads, max_grad, {ABSOLUTE}, extent)")
                for way in ("clone", "split")
            ),
        ],
        TRAIN: [
            adding("import torch\n", before="import open3d as o3d  # noqa: F401\n"),
            adding("    background = torch.tensor(", before=f"    {FILTER}"),
            (
                "        package = render(camera, gaussians, pipe, bg)\n",
                "        size = camera.image_height, camera.image_width, 2\n"
                '        jitter = torch.rand(size, device="cuda") - 0.5\n'
                "        how = {'kernel_size': dataset.kernel_size}\n"
                "        how['subpixel_offset'] = jitter if dataset.ray_jitter else None\n"
                "        package = render(camera, gaussians, pipe, bg, **how)\n",
            ),
            ("render, (pipe, background))", "render, (pipe, background, dataset.kernel_size))"),
            adding("scene.cameras_extent, largest)\n", after=f"        {FILTER}"),
            adding(
                STEP,
                before="            elif iteration % 5 == 0 and iteration < opt.iterations - 5:\n"
                f"                {FILTER}",
            ),
        ],
        "render.py": [
            ("pipeline, background)[", "pipeline, background, kernel_size)["),
            ("gaussians, pipeline, background):", "gaussians, pipeline, background, kernel_size):"),
            ("background)\n", "background, dataset.kernel_size)\n"),
            ('folder / "renders"', 'folder / "test_preds_1"'),
            ('folder / "gt"', 'folder / "gt_1"'),
        ],
    }
    added = (Added,)
    files = {"create_fused_ply.py": FUSE}

    def refresh(self, model: Any) -> None:
        """As the training loop does after every change of rows."""
        if len(getattr(model, "filter_3D", ())) != len(model.get_xyz):
            model.compute_3D_filter([self.camera(24, 18)])

    def model(self, *args: Any, **options: Any) -> Any:
        """With a filter, as before the training loop."""
        model = super().model(*args, **options)
        self.refresh(model)
        return model

    def camera(self, width: int, height: int, *, side: float = 0.0) -> Any:
        """With what the real host's filter reads."""
        camera = super().camera(width, height, side=side)
        camera.R, camera.T = np.eye(3), np.array([side, 0.0, 3.0])
        camera.focal_x = width / (2 * math.tan(camera.FoVx / 2))
        camera.focal_y = height / (2 * math.tan(camera.FoVy / 2))
        return camera

    def render(self, camera: Any, model: Any, background: Any, **more: Any) -> dict[str, Any]:
        """With the filter's size."""
        self.refresh(model)
        render = import_module("gaussian_renderer").render
        return render(camera, model, self.pipe(), background, 0.1, **more)

    def step(self, model: Any, camera: Any, iteration: int, background: Any) -> float:
        """Rows first have a filter."""
        self.refresh(model)
        return super().step(model, camera, iteration, background)

    def save(self, model: Any, path: Path) -> None:
        """The filter is saved with the model."""
        self.refresh(model)
        super().save(model, path)

    def actions(self) -> Any:
        """Resetting opacities reads the filter; densification takes absolute gradients too."""
        shared = dict(super().actions())
        reset = shared["reset opacity"]

        def refreshed(model: Any, arguments: Any, chance: Any) -> None:
            self.refresh(model)
            reset(model, arguments, chance)

        def densifying(name: str, all_rows: float) -> Any:
            def act(model: Any, arguments: Any, chance: Any) -> None:
                n = len(model.get_xyz)
                grads, grads_abs = chance.uniform(n, 1), chance.uniform(n, 1)
                extent = all_rows if chance.seed % 3 else 3.0
                quantile = torch.quantile(grads_abs, 1 - chance.share / 2)
                getattr(model, name)(grads, 1 - chance.share / 2, grads_abs, quantile, extent)

            return act

        def both(model: Any, arguments: Any, chance: Any) -> None:
            model.xyz_gradient_accum_abs = chance.uniform(len(model.get_xyz), 1)
            shared["densify and prune"](model, arguments, chance)

        return {
            **shared,
            "reset opacity": refreshed,
            "clone": densifying("densify_and_clone", 1e6),
            "split": densifying("densify_and_split", 1e-6),
            "densify and prune": both,
        }
