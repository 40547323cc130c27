"""The Gaussians, their optimizer, and the operations that add and remove them."""

from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from simple_knn._C import distCUDA2
from torch import nn
from utils.general_utils import build_covariance, build_rotation, get_expon_lr_func, inverse_sigmoid
from utils.sh_utils import RGB2SH


class GaussianModel:
    """N Gaussians; the underscored tensors are raw, the ``get_`` properties activated."""

    def setup_functions(self):
        """Set the activations and their inverses."""
        self.scaling_activation, self.scaling_inverse_activation = torch.exp, torch.log
        self.opacity_activation, self.inverse_opacity_activation = torch.sigmoid, inverse_sigmoid
        self.rotation_activation = nn.functional.normalize
        self.covariance_activation = build_covariance

    def __init__(self, sh_degree: int):
        self.active_sh_degree, self.max_sh_degree = 0, sh_degree
        empty = torch.empty(0)
        self._xyz, self._features_dc, self._features_rest = empty, empty, empty
        self._scaling, self._rotation, self._opacity = empty, empty, empty
        self.max_radii2D, self.xyz_gradient_accum, self.denom = empty, empty, empty
        self.optimizer, self.percent_dense, self.spatial_lr_scale = None, 0, 0
        self.setup_functions()

    def capture(self):
        """The 12 entries of a checkpoint, from which training resumes."""
        return (
            self.active_sh_degree,
            self._xyz,
            self._features_dc,
            self._features_rest,
            self._scaling,
            self._rotation,
            self._opacity,
            self.max_radii2D,
            self.xyz_gradient_accum,
            self.denom,
            self.optimizer.state_dict(),
            self.spatial_lr_scale,
        )

    def restore(self, model_args, training_args):
        """Restore the entries that ``capture`` returned."""
        (
            self.active_sh_degree,
            self._xyz,
            self._features_dc,
            self._features_rest,
            self._scaling,
            self._rotation,
            self._opacity,
            self.max_radii2D,
            accumulated,
            denominator,
            optimizer_state,
            self.spatial_lr_scale,
        ) = model_args
        self.training_setup(training_args)
        self.xyz_gradient_accum, self.denom = accumulated, denominator
        self.optimizer.load_state_dict(optimizer_state)

    @property
    def get_scaling(self):
        """Standard deviations (N, 3)."""
        return self.scaling_activation(self._scaling)

    @property
    def get_rotation(self):
        """Unit quaternions (N, 4), w first."""
        return self.rotation_activation(self._rotation)

    @property
    def get_xyz(self):
        """Centres (N, 3)."""
        return self._xyz

    @property
    def get_features(self):
        """SH coefficients (N, K, 3)."""
        return torch.cat((self._features_dc, self._features_rest), dim=1)

    @property
    def get_opacity(self):
        """Opacities (N, 1) in (0, 1)."""
        return self.opacity_activation(self._opacity)

    def get_covariance(self, scaling_modifier=1):
        """Upper triangles (N, 6) of the covariances."""
        return self.covariance_activation(self.get_scaling, scaling_modifier, self._rotation)

    def oneupSHdegree(self):  # noqa: N802 - the name callers use
        """Use one more band of SH, up to the maximum."""
        self.active_sh_degree = min(self.active_sh_degree + 1, self.max_sh_degree)

    # Birth ----------------------------------------------------------------------------------

    def create_from_pcd(self, pcd, spatial_lr_scale: float):
        """Make one round Gaussian for each point, as wide as the distance to its neighbours."""
        self.spatial_lr_scale = spatial_lr_scale
        points = torch.tensor(np.asarray(pcd.points)).float().cuda()
        colours = RGB2SH(torch.tensor(np.asarray(pcd.colors)).float().cuda())
        n, bands = len(points), (self.max_sh_degree + 1) ** 2
        scales = torch.sqrt(torch.clamp_min(distCUDA2(points), 1e-7))
        rotations = torch.zeros((n, 4), device="cuda")
        rotations[:, 0] = 1
        self._adopt(
            {
                "xyz": points,
                "f_dc": colours[:, None, :],
                "f_rest": torch.zeros((n, bands - 1, 3), device="cuda"),
                "opacity": inverse_sigmoid(torch.full((n, 1), 0.1, device="cuda")),
                "scaling": self.scaling_inverse_activation(scales)[:, None].repeat(1, 3),
                "rotation": rotations,
            }
        )
        self.max_radii2D = torch.zeros(n, device="cuda")

    def training_setup(self, training_args):
        """Make a new optimizer with one group for each tensor."""
        self.percent_dense = training_args.percent_dense
        self._reset_statistics()
        rates = {
            "xyz": (self._xyz, training_args.position_lr_init * self.spatial_lr_scale),
            "f_dc": (self._features_dc, training_args.feature_lr),
            "f_rest": (self._features_rest, training_args.feature_lr / 20),
            "opacity": (self._opacity, training_args.opacity_lr),
            "scaling": (self._scaling, training_args.scaling_lr),
            "rotation": (self._rotation, training_args.rotation_lr),
        }
        groups = [{"params": [p], "lr": lr, "name": name} for name, (p, lr) in rates.items()]
        self.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
        self.xyz_scheduler_args = get_expon_lr_func(
            training_args.position_lr_init * self.spatial_lr_scale,
            training_args.position_lr_final * self.spatial_lr_scale,
            training_args.position_lr_max_steps,
        )

    def update_learning_rate(self, iteration):
        """Set and return the learning rate of the positions."""
        rate = self.xyz_scheduler_args(iteration)
        for group in self.optimizer.param_groups:
            if group["name"] == "xyz":
                group["lr"] = rate
        return rate

    # Files ----------------------------------------------------------------------------------

    def construct_list_of_attributes(self):
        """Names of the PLY's columns, in order."""
        counts = {
            "f_dc_": self._features_dc[0].numel(),
            "f_rest_": self._features_rest[0].numel(),
            "opacity": None,
            "scale_": self._scaling.shape[1],
            "rot_": self._rotation.shape[1],
        }
        names = ["x", "y", "z", "nx", "ny", "nz"]
        for prefix, count in counts.items():
            names += [prefix] if count is None else [f"{prefix}{i}" for i in range(count)]
        return names

    def save_ply(self, path):
        """Write the raw tensors as PLY; SH go channel by channel."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        columns = [
            self._xyz,
            torch.zeros_like(self._xyz),
            self._features_dc.transpose(1, 2).flatten(1),
            self._features_rest.transpose(1, 2).flatten(1),
            self._opacity,
            self._scaling,
            self._rotation,
        ]
        table = torch.cat(columns, dim=1).detach().cpu().numpy()
        rows = np.empty(len(table), dtype=[(n, "f4") for n in self.construct_list_of_attributes()])
        for index, name in enumerate(rows.dtype.names):
            rows[name] = table[:, index]
        PlyData([PlyElement.describe(rows, "vertex")]).write(path)

    def load_ply(self, path):
        """Read a PLY that ``save_ply`` wrote."""
        vertex = PlyData.read(path)["vertex"]
        names = [p.name for p in vertex.properties]

        def columns(*wanted):
            table = np.stack([np.asarray(vertex[name]) for name in wanted], axis=1)
            return torch.tensor(table, dtype=torch.float, device="cuda")

        def numbered(prefix):
            found = [name for name in names if name.startswith(prefix)]
            return sorted(found, key=lambda name: int(name.rsplit("_", 1)[1]))

        n, rest = len(vertex.data), numbered("f_rest_")
        self._adopt(
            {
                "xyz": columns("x", "y", "z"),
                "f_dc": columns(*numbered("f_dc_")).view(n, 3, 1).transpose(1, 2).contiguous(),
                "f_rest": columns(*rest).view(n, 3, -1).transpose(1, 2).contiguous()
                if rest
                else torch.zeros((n, 0, 3), device="cuda"),
                "opacity": columns("opacity"),
                "scaling": columns(*numbered("scale_")),
                "rotation": columns(*numbered("rot")),
            }
        )
        self.active_sh_degree = self.max_sh_degree

    # Optimizer surgery ----------------------------------------------------------------------

    def _adopt(self, tensors):
        """Bind the six tensors, as parameters, to their attributes."""
        as_parameter = {
            name: t if isinstance(t, nn.Parameter) else nn.Parameter(t.requires_grad_(True))
            for name, t in tensors.items()
        }
        self._xyz, self._opacity = as_parameter["xyz"], as_parameter["opacity"]
        self._features_dc, self._features_rest = as_parameter["f_dc"], as_parameter["f_rest"]
        self._scaling, self._rotation = as_parameter["scaling"], as_parameter["rotation"]

    def _reset_statistics(self):
        n = self.get_xyz.shape[0]
        self.xyz_gradient_accum = torch.zeros((n, 1), device="cuda")
        self.denom = torch.zeros((n, 1), device="cuda")

    def _replace(self, group, tensor, change_moment):
        """Put a new parameter in a group; its moments go through change_moment."""
        state = self.optimizer.state.pop(group["params"][0], None)
        group["params"][0] = nn.Parameter(tensor.requires_grad_(True))
        if state is not None:
            for key in ("exp_avg", "exp_avg_sq"):
                state[key] = change_moment(state[key])
            self.optimizer.state[group["params"][0]] = state
        return group["params"][0]

    def replace_tensor_to_optimizer(self, tensor, name):
        """Replace the values of one group and zero its moments."""
        return {
            group["name"]: self._replace(group, tensor, torch.zeros_like)
            for group in self.optimizer.param_groups
            if group["name"] == name
        }

    def _prune_optimizer(self, mask):
        """Keep the rows where mask is True, in every group."""
        return {
            group["name"]: self._replace(
                group, group["params"][0].detach()[mask], lambda moment: moment[mask]
            )
            for group in self.optimizer.param_groups
        }

    def cat_tensors_to_optimizer(self, tensors_dict):
        """Append rows to every group, with zero moments."""
        grown = {}
        for group in self.optimizer.param_groups:
            new = tensors_dict[group["name"]]
            grown[group["name"]] = self._replace(
                group,
                torch.cat((group["params"][0].detach(), new.detach())),
                lambda moment, new=new: torch.cat((moment, torch.zeros_like(new))),
            )
        return grown

    # Density control ------------------------------------------------------------------------

    def reset_opacity(self):
        """Lower opacities to at most 0.01."""
        low = inverse_sigmoid(torch.clamp_max(self.get_opacity.detach(), 0.01))
        self._opacity = self.replace_tensor_to_optimizer(low, "opacity")["opacity"]

    def prune_points(self, mask):
        """Remove the rows where mask is True."""
        keep = ~mask
        self._adopt(self._prune_optimizer(keep))
        self.xyz_gradient_accum = self.xyz_gradient_accum[keep]
        self.denom, self.max_radii2D = self.denom[keep], self.max_radii2D[keep]

    def densification_postfix(
        self, new_xyz, new_features_dc, new_features_rest, new_opacities, new_scaling, new_rotation
    ):
        """Append Gaussians and reset the statistics."""
        new = {
            "xyz": new_xyz,
            "f_dc": new_features_dc,
            "f_rest": new_features_rest,
            "opacity": new_opacities,
            "scaling": new_scaling,
            "rotation": new_rotation,
        }
        self._adopt(self.cat_tensors_to_optimizer(new))
        self._reset_statistics()
        self.max_radii2D = torch.zeros(self.get_xyz.shape[0], device="cuda")

    def _needy(self, grads, grad_threshold, scene_extent, large):
        """Mask of large (or small) rows with a screen gradient; new rows have no gradient."""
        moved = torch.zeros(self.get_xyz.shape[0], device="cuda")
        moved[: grads.shape[0]] = torch.norm(grads, dim=-1)
        is_large = self.get_scaling.max(dim=1).values > self.percent_dense * scene_extent
        return (moved >= grad_threshold) & (is_large if large else ~is_large)

    def densify_and_clone(self, grads, grad_threshold, scene_extent):
        """Clone the selected small Gaussians."""
        chosen = self._needy(grads, grad_threshold, scene_extent, large=False)
        self.densification_postfix(
            self._xyz[chosen],
            self._features_dc[chosen],
            self._features_rest[chosen],
            self._opacity[chosen],
            self._scaling[chosen],
            self._rotation[chosen],
        )

    def densify_and_split(self, grads, grad_threshold, scene_extent, N=2):
        """Replace each selected large Gaussian by N smaller ones, sampled from it."""
        chosen = self._needy(grads, grad_threshold, scene_extent, large=True)
        spread = self.get_scaling[chosen].repeat(N, 1)
        turn = build_rotation(self._rotation[chosen]).repeat(N, 1, 1)
        offset = (turn @ torch.normal(torch.zeros_like(spread), spread)[..., None])[..., 0]
        self.densification_postfix(
            self.get_xyz[chosen].repeat(N, 1) + offset,
            self._features_dc[chosen].repeat(N, 1, 1),
            self._features_rest[chosen].repeat(N, 1, 1),
            self._opacity[chosen].repeat(N, 1),
            self.scaling_inverse_activation(spread / (0.8 * N)),
            self._rotation[chosen].repeat(N, 1),
        )
        children = torch.zeros(len(spread), dtype=torch.bool, device="cuda")
        self.prune_points(torch.cat((chosen, children)))

    def densify_and_prune(self, max_grad, min_opacity, extent, max_screen_size):
        """Clone, split, then remove faint and huge Gaussians."""
        grads = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)
        self.densify_and_clone(grads, max_grad, extent)
        self.densify_and_split(grads, max_grad, extent)
        unwanted = (self.get_opacity < min_opacity).squeeze(-1)
        if max_screen_size:
            unwanted |= self.max_radii2D > max_screen_size
            unwanted |= self.get_scaling.max(dim=1).values > 0.1 * extent
        self.prune_points(unwanted)
        torch.cuda.empty_cache()

    def add_densification_stats(self, viewspace_point_tensor, update_filter):
        """Accumulate screen gradients of the visible Gaussians."""
        moved = torch.norm(viewspace_point_tensor.grad[update_filter, :2], dim=-1, keepdim=True)
        self.xyz_gradient_accum[update_filter] += moved
        self.denom[update_filter] += 1
