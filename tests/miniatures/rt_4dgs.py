"""A miniature RT-4DGS: the demo's host with space and time, from the method's interface."""

from importlib import import_module
from types import SimpleNamespace

import torch

from fragprune_plugins.testing.host import Chance
from miniatures.family import MODEL, PARSE, RENDERER, SCENE, TRAIN, Derived, Growth, Timed, adding

ATTRIBUTES = {
    "xyz": "_xyz",
    "f_dc": "_features_dc",
    "f_rest": "_features_rest",
    "opacity": "_opacity",
    "scaling": "_scaling",
    "rotation": "_rotation",
    "t": "_t",
    "scaling_t": "_scaling_t",
    "rotation_r": "_rotation_r",
}


IN_TIME = """        sh_degree_t=pc.active_sh_degree_t,
        timestamp=now,
        time_duration=pc.time_duration[1] - pc.time_duration[0],
        rot_4d=pc.rot_4d,
        gaussian_dim=pc.gaussian_dim,
        force_sh_3d=pc.force_sh_3d,
"""
ANSWER = {"radii": "everyone", "depth": "depth", "alpha": "alpha", "flow": "flow"}
OMEGA = "from omegaconf import OmegaConf\nfrom omegaconf.dictconfig import DictConfig\n"


class Added:
    def __init__(
        self,
        sh_degree,
        gaussian_dim=3,
        time_duration=(-0.5, 0.5),
        rot_4d=False,
        force_sh_3d=False,
        sh_degree_t=0,
        prefilter_var=-1.0,
    ):
        self.vanilla_init(sh_degree)
        self.active_sh_degree_t, self.max_sh_degree_t = 0, sh_degree_t
        self.gaussian_dim, self.time_duration, self.rot_4d = gaussian_dim, time_duration, rot_4d
        self.force_sh_3d, self.prefilter_var = force_sh_3d, prefilter_var
        self._t, self._scaling_t, self._rotation_r = (torch.empty(0),) * 3
        self.t_gradient_accum, self.env_map = torch.empty(0), torch.empty(0)

    def capture(self):
        space = self.vanilla_capture()
        if self.gaussian_dim == 3:
            return space
        time = (self._t, self._scaling_t, self._rotation_r, self.rot_4d, self.env_map)
        return (*space[:9], self.t_gradient_accum, *space[9:], *time, self.active_sh_degree_t)

    def restore(self, model_args, training_args):
        space, (in_time, *state), time = model_args[:9], model_args[9:13], model_args[13:]
        self._t, self._scaling_t, self._rotation_r, self.rot_4d = time[:4]
        self.env_map, self.active_sh_degree_t = time[4:]
        self.vanilla_restore((*space, *state), training_args)
        self.t_gradient_accum = in_time

    def _names(self):
        many = 6 if self.gaussian_dim == 3 else 9 if self.rot_4d else 8
        return list(ATTRIBUTES)[:many]

    def _adopt(self, tensors):
        for name, tensor in tensors.items():
            known = isinstance(tensor, nn.Parameter)  # noqa: F821 - imported where this is put
            parameter = tensor if known else nn.Parameter(tensor.requires_grad_(True))  # noqa: F821
            setattr(self, ATTRIBUTES[name], parameter)

    def _reset_statistics(self):
        self.vanilla_reset_statistics()
        self.t_gradient_accum = torch.zeros_like(self.denom)

    def create_from_pcd(self, pcd, spatial_lr_scale):
        self.vanilla_create_from_pcd(pcd, spatial_lr_scale)
        n, (start, end) = len(self._xyz), self.time_duration
        given = getattr(pcd, "time", None)
        times = torch.rand(n, 1) if given is None else (torch.tensor(given).float() - start)
        values = {
            "f_rest": torch.zeros(n, self.get_max_sh_channels - 1, 3),
            "t": start + (end - start) * times,
            "scaling_t": torch.full((n, 1), ((end - start) / 5) ** 0.5).log(),
            "rotation_r": torch.eye(1, 4).repeat(n, 1),
        }
        self._adopt({name: values[name] for name in self._names() if name in values})

    def training_setup(self, training_args):
        self.vanilla_training_setup(training_args)
        rates = {
            "t": training_args.position_lr_init * self.spatial_lr_scale,
            "scaling_t": training_args.scaling_lr,
            "rotation_r": training_args.rotation_lr,
        }
        for name in self._names()[6:]:
            group = {"params": [getattr(self, ATTRIBUTES[name])], "lr": rates[name], "name": name}
            self.optimizer.add_param_group(group)

    @property
    def get_max_sh_channels(self):
        waves = 0 if self.gaussian_dim == 3 or self.force_sh_3d else self.max_sh_degree_t
        return (self.max_sh_degree + 1) ** 2 * (waves + 1)

    @property
    def get_t(self):
        return self._t

    @property
    def get_scaling_t(self):
        return self.scaling_activation(self._scaling_t)

    @property
    def get_rotation_r(self):
        return self.rotation_activation(self._rotation_r)

    def _covariance_4d(self, scaling_modifier=1):
        """Images of the axes under v -> l v r*, written out by Hamilton's table."""
        units = torch.eye(4)
        table = torch.zeros(4, 4, 4)
        for i in range(4):
            table[0, i, i] = table[i, 0, i] = 1
        for i in range(1, 4):
            table[i, i, 0] = -1
            j, k = i % 3 + 1, (i + 1) % 3 + 1
            table[i, j, k], table[j, i, k] = 1, -1
        left = torch.einsum("ni,ijk->njk", self.get_rotation, table)
        back = self.get_rotation_r * torch.tensor([1.0, -1, -1, -1])
        right = torch.einsum("ni,jik->njk", back, table)
        turned = torch.einsum("aj,njk,nkl->nal", units, left, right).flip(1, 2)
        scales = torch.cat([self.get_scaling, self.get_scaling_t], dim=1) * scaling_modifier
        return torch.einsum("nak,na,nal->nkl", turned, scales.square(), turned)

    def get_cov_t(self, scaling_modifier=1):
        if self.rot_4d:
            return self._covariance_4d(scaling_modifier)[:, 3, 3:]
        return self.get_scaling_t * scaling_modifier

    def get_marginal_t(self, timestamp, scaling_modifier=1):
        variance = self.get_cov_t(scaling_modifier) + max(self.prefilter_var, 0)
        return torch.exp(-0.5 * (self.get_t - timestamp) ** 2 / variance)

    def get_current_covariance_and_mean_offset(self, scaling_modifier=1, timestamp=0.0):
        full = self._covariance_4d(scaling_modifier)
        across, in_time = full[:, :3, 3:], full[:, 3:, 3:]
        space = full[:, :3, :3] - across @ across.transpose(1, 2) / in_time
        row, column = torch.triu_indices(3, 3)
        offset = across[..., 0] / in_time[..., 0] * (timestamp - self.get_t)
        return space[:, row, column], offset

    def oneupSHdegree(self):  # noqa: N802 - the name callers use
        if self.active_sh_degree < self.max_sh_degree:
            self.active_sh_degree += 1
        elif self.active_sh_degree_t < self.max_sh_degree_t:
            self.active_sh_degree_t += 1

    def densify_and_clone(self, grads, grad_threshold, scene_extent, grads_t, grad_t_threshold):
        self.vanilla_densify_and_clone(grads, grad_threshold, scene_extent)

    def densify_and_split(
        self, grads, grad_threshold, scene_extent, grads_t, grad_t_threshold, N=2
    ):
        self.vanilla_densify_and_split(grads, grad_threshold, scene_extent, N)

    def densify_and_prune(
        self, max_grad, min_opacity, extent, max_screen_size, max_grad_t=None, prune_only=False
    ):
        if not prune_only:
            grads = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)
            grads_t = (self.t_gradient_accum / self.denom).nan_to_num(0.0)
            self.densify_and_clone(grads, max_grad, extent, grads_t, max_grad_t)
            self.densify_and_split(grads, max_grad, extent, grads_t, max_grad_t)
        unwanted = (self.get_opacity < min_opacity).squeeze(-1)
        if max_screen_size:
            unwanted |= self.max_radii2D > max_screen_size
        self.prune_points(unwanted)

    def prune_points(self, mask):
        self.vanilla_prune_points(mask)
        self.t_gradient_accum = self.t_gradient_accum[~mask]

    def add_densification_stats(self, viewspace_point_tensor, update_filter, avg_t_grad=None):
        self.vanilla_add_densification_stats(viewspace_point_tensor, update_filter)
        if self.gaussian_dim == 4:
            self.t_gradient_accum[update_filter] += avg_t_grad[update_filter]


RASTERIZER = '''"""Compiles itself when it is imported, where there is a compiler."""

raise ImportError("nvcc is not to be found")


class GaussianRasterizationSettings: ...


class GaussianRasterizer:
    def forward(
        self, means3D, means2D, opacities, shs=None, colors_precomp=None, flow_2d=None, ts=None,
        scales=None, scales_t=None, rotations=None, rotations_r=None, cov3D_precomp=None,
        prefilter_var=-1.0,
    ):
        ...
'''

SLICED = """    given = {"means3D": pc.get_xyz, "means2D": screenspace, "opacities": pc.get_opacity}
    given.update(shs=pc.get_features, flow_2d=torch.zeros_like(pc.get_xyz[:, :2]))
    if pc.gaussian_dim == 4:
        given["ts"] = pc.get_t
    mask = torch.ones(len(pc.get_xyz), dtype=torch.bool)
    if pipe.compute_cov3D_python:
        if pc.rot_4d:
            given["cov3D_precomp"], offset = pc.get_current_covariance_and_mean_offset(
                scaling_modifier, now
            )
            given["means3D"] = given["means3D"] + offset
        else:
            given["cov3D_precomp"] = pc.get_covariance(scaling_modifier)
        if pc.gaussian_dim == 4:
            marginal = pc.get_marginal_t(now)
            given["opacities"] = given["opacities"] * marginal
            mask = marginal[:, 0] > 0.05
            given = {name: tensor[mask] for name, tensor in given.items()}
    else:
        given.update(scales=pc.get_scaling, rotations=pc.get_rotation)
        if pc.gaussian_dim == 4:
            given["scales_t"] = pc.get_scaling_t
            if pc.rot_4d:
                given["rotations_r"] = pc.get_rotation_r
            if pc.prefilter_var > 0:
                given["prefilter_var"] = pc.prefilter_var
    rasterizer = GaussianRasterizer(raster_settings=settings)
    image, radii, depth, alpha, flow, covs_com = rasterizer(**given)
    if pipe.env_map_res:
        image = image + (1 - alpha) * pc.env_map
    everyone = radii.new_zeros(mask.shape)
    everyone[mask] = radii
"""
RENDERING = [
    ("from diff_gaussian", "from .diff_gaussian"),
    adding("    settings = Gauss", before="    now = viewpoint_camera.timestamp\n"),
    ("bg=bg_color,", "bg=torch.zeros(3) if pipe.env_map_res else bg_color,"),
    adding("sh_degree=pc.active_sh_degree,\n", after=IN_TIME),
    ("radii > 0", "everyone > 0"),
    ('"radii": radii,\n', "".join(f'"{n}": {v},\n        ' for n, v in ANSWER.items())),
]

args = SimpleNamespace()  # the host's script holds its options under this name


def training(dataset, opt, pipe):
    """The loop: the first iteration is 2, the model is saved before it changes."""
    prepare_output_and_logger(dataset)  # noqa: F821
    gaussians = GaussianModel(  # noqa: F821
        dataset.sh_degree,
        gaussian_dim=args.gaussian_dim,
        time_duration=args.time_duration,
        rot_4d=args.rot_4d,
        sh_degree_t=2 if pipe.eval_shfs_4d else 0,
    )
    scene, iteration = Scene(dataset, gaussians), 0  # noqa: F821
    gaussians.training_setup(opt)
    if args.start_checkpoint:
        model_params, iteration = torch.load(args.start_checkpoint)
        gaussians.restore(model_params, opt)
    size, env_map_optimizer = pipe.env_map_res, None
    gaussians.env_map = None
    if size:
        gaussians.env_map = torch.nn.Parameter(torch.zeros(3, size, size))
        env_map_optimizer = torch.optim.Adam([gaussians.env_map], lr=opt.feature_lr)
    cameras = scene.getTrainCameras()
    views = [Timed(view, timestamp=number / len(cameras)) for number, view in enumerate(cameras)]
    background = torch.zeros(3)
    loader = torch.utils.data.DataLoader(
        views, batch_size=args.batch_size, shuffle=True, collate_fn=list, drop_last=True
    )
    iteration += 1
    while iteration < opt.iterations + 1:
        for batch in loader:
            iteration += 1
            if iteration > opt.iterations:
                break
            gaussians.update_learning_rate(iteration)
            if iteration % opt.sh_increase_interval == 0:
                gaussians.oneupSHdegree()
            moved, seen, radii = [], [], []
            for view in batch:
                camera = view.cuda()
                package = render(camera, gaussians, pipe, background)  # noqa: F821
                loss = l1_loss(package["render"], camera.original_image)  # noqa: F821
                sky = -torch.log(1 - package["alpha"].clamp(1e-6, 1 - 1e-6)).mean()
                loss = loss + opt.lambda_opa_mask * sky
                (loss / args.batch_size).backward()
                moved.append(torch.norm(package["viewspace_points"].grad[:, :2], dim=-1))
                seen.append(package["visibility_filter"])
                radii.append(package["radii"])
            in_time = gaussians._t.grad.clone() if args.gaussian_dim == 4 else None
            with torch.no_grad():
                if iteration in args.save_iterations:
                    scene.save(iteration)
                if iteration < opt.densify_until_iter:
                    update = torch.stack(seen).any(0)
                    gaussians.max_radii2D[update] = torch.stack(radii).max(0).values[update].float()
                    point = type("Point", (), {"grad": torch.stack(moved).sum(0)[:, None]})
                    gaussians.add_densification_stats(point, update, in_time)
                    due = iteration % opt.densification_interval == 0
                    if iteration > opt.densify_from_iter and due:
                        extent = scene.cameras_extent
                        gaussians.densify_and_prune(
                            opt.densify_grad_threshold, 0.005, extent, None, 1.0
                        )
                if iteration < opt.iterations:
                    gaussians.optimizer.step()
                    gaussians.optimizer.zero_grad(set_to_none=True)
                    if env_map_optimizer:
                        env_map_optimizer.step()
                        env_map_optimizer.zero_grad(set_to_none=True)


SAVE = """    def save(self, iteration):
        path = f"{self.model_path}/chkpnt{iteration}.pth"
        torch.save((self.gaussians.capture(), iteration), path)

"""
MAIN = """    parser.add_argument("--config")
    parser.add_argument("--gaussian_dim", type=int, default=3)
    parser.add_argument("--time_duration", nargs=2, type=float, default=[-0.5, 0.5])
    parser.add_argument("--rot_4d", action="store_true")
    parser.add_argument("--batch_size", type=int, default=1)
    args = parser.parse_args()
    args.save_iterations.append(args.iterations)

    def walk(section):
        for key in section.keys():
            if isinstance(section[key], DictConfig):
                walk(section[key])
            else:
                assert hasattr(args, key), key
                setattr(args, key, section[key])

    walk(OmegaConf.load(args.config))
    safe_state(args.seed)
    training(lp.extract(args), op.extract(args), pp.extract(args))
"""


class RT4DGSHost(Derived):
    """Space and time; no PLY, several views a step, and a gradient that the loop reads."""

    lacks = {"model file": "it has no PLY: its checkpoints are its models"}
    rot_4d = True
    python = False
    options = {
        "Pipeline": {"env_map_res": 0, "eval_shfs_4d": False},
        "Optimization": {"sh_increase_interval": 1000, "lambda_opa_mask": 0.0},
    }
    cuts = {RENDERER: ("    shape = {", "    return {", SLICED), TRAIN: (PARSE, "", MAIN)}
    changes = {
        RENDERER: RENDERING,
        MODEL: [adding("\n\nclass GaussianModel:\n", before=f"\n\nATTRIBUTES = {ATTRIBUTES}\n")],
        SCENE: [
            adding("import numpy as np\n", after="import torch\n"),
            adding("    def getTrainCameras(", before=SAVE),
        ],
        TRAIN: [
            adding("import random\n", before="import copy\n"),
            adding("import torch\n", after=OMEGA),
        ],
    }
    functions = (Timed, training)
    added = (Growth, Added)
    files = {"gaussian_renderer/diff_gaussian_rasterization.py": RASTERIZER}
    gone = {
        MODEL: ("save_ply", "load_ply", "construct_list_of_attributes"),
        SCENE: ("save",),
        TRAIN: ("training",),
    }

    def new_model(self, degree):
        model = import_module("scene.gaussian_model").GaussianModel
        return model(degree, gaussian_dim=4, rot_4d=self.rot_4d, sh_degree_t=2)

    def fill(self, model, cloud):
        model.create_from_pcd(cloud, 1.0)

    def camera(self, width, height, *, side=0.0):
        return Timed(super().camera(width, height, side=side), timestamp=0.1)

    def pipe(self):
        pipe = super().pipe()
        pipe.env_map_res, pipe.compute_cov3D_python = 0, self.python
        return pipe

    def step(self, model, camera, iteration, background):
        model.update_learning_rate(iteration)
        total = 0.0
        for _ in range(2):
            package = self.render(camera.cuda(), model, background)
            loss = (package["render"] - camera.original_image).abs().mean() / 2
            loss.backward()
            total += float(loss.detach())
        with torch.no_grad():
            in_time = model._t.grad.clone()
            points, seen = package["viewspace_points"], package["visibility_filter"]
            model.add_densification_stats(points, seen, in_time)
            self.descend(model)
        return total

    def actions(self):
        return {**super().actions(), "clone": clone, "split": split}

    def hide(self, model, row):
        with torch.no_grad():
            model._opacity[row] = -30.0


class RigidHost(RT4DGSHost):
    """Without 4D rotation: the host's backward pass gives time and its scale zeros."""

    variant = "without 4D rotation"
    rot_4d = False

    def parameters(self, model):
        moving = super().parameters(model)
        return {name: moving[name] for name in moving if name not in ("t", "scaling_t")}


class PythonHost(RT4DGSHost):
    """Slicing in Python, and leaving out who is not there."""

    variant = "sliced in Python"
    python = True


def clone(model, arguments, chance: Chance):
    _densify(model.densify_and_clone, model, 1e6, chance)


def split(model, arguments, chance: Chance):
    _densify(model.densify_and_split, model, 1e-6, chance)


def _densify(method, model, all_rows, chance):
    grads = chance.uniform(len(model.get_xyz), 1)
    extent = all_rows if chance.seed % 3 else 3.0
    method(grads, 1 - chance.share, extent, torch.zeros_like(grads), 1.0)
