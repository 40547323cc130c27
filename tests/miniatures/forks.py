"""A fork of 3DGS with nothing inside: what its scripts, model and renderer say, to be varied."""

from pathlib import Path

from fragprune_plugins.hosts.source import HostRepo
from miniatures.skeletons import FLAGS, skeleton

MODEL = """
class GaussianModel:
    def __init__(self, sh_degree): ...

    def setup_functions(self):
        self.scaling_activation = torch.exp
        self.opacity_activation = torch.sigmoid

    @property
    def get_xyz(self):
        return self._xyz

    @property
    def get_opacity(self):
        return self.opacity_activation(self._opacity)

    @property
    def get_scaling(self):
        return self.scaling_activation(self._scaling)

    def capture(self):
        values = (self._features_dc, self._features_rest, self._opacity, self._rotation)
        return (self._xyz, self._scaling, *values, self.optimizer.state_dict(), self.ground)

    def restore(self, model_args, training_args):
        self.training_setup(training_args)

    def construct_list_of_attributes(self):
        return ["x", "y", "z", "opacity", "f_dc_0", "f_rest_0", "scale_0", "rot_0"]

    def save_ply(self, path): ...

    def load_ply(self, path): ...

    def training_setup(self, training_args):
        groups = [
            {"params": [self._xyz], "name": "xyz"},
            {"params": [self._features_dc], "name": "f_dc"},
            {"params": [self._opacity], "name": "opacity"},
            {"params": [self._scaling], "name": "scaling"},
            {"params": [self._rotation], "name": "rotation"},
            {"params": [self._features_rest], "name": "f_rest"},
            {"params": [self.ground], "name": "ground"},
        ]
        self.optimizer = torch.optim.Adam(groups)

    def update_learning_rate(self, iteration): ...

    def oneupSHdegree(self): ...

    def _prune_optimizer(self, mask):
        return {group["name"]: group["params"][0][mask] for group in self.optimizer.param_groups}

    def cat_tensors_to_optimizer(self, tensors_dict): ...

    def replace_tensor_to_optimizer(self, tensor, name): ...

    def thin_out(self, mask):
        kept = self._prune_optimizer(mask)

    def spread(self, grads):
        self.clone_some(grads)

    def clone_some(self, grads):
        self.cat_tensors_to_optimizer({})
"""

RENDER = """
from {package} import GaussianRasterizationSettings, GaussianRasterizer


def render(viewpoint_camera, pc, pipe, bg_color, override_color=None, chosen=None):
    s = GaussianRasterizationSettings({settings})
    rasterizer = GaussianRasterizer(raster_settings=s)
    means3D = pc.get_xyz
    if chosen is not None:
        means3D = means3D[chosen]
    shs = pc.get_features
    {values} = rasterizer(
        means3D=means3D, means2D=pc.get_xyz, opacities=pc.get_opacity, shs=shs{arguments}
    )
    return {{"render": image, "radii": radii{keys}}}
"""

TRAIN = (
    """
from gaussian_renderer import render
from given import *
from scene import GaussianModel, Scene


def training(opt, checkpoint):
    gaussians = GaussianModel(3)
    scene = Scene(opt, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        gaussians.restore(torch.load(checkpoint), opt)
    for iteration in range(opt.iterations):
        gaussians.update_learning_rate(iteration)
        gaussians.oneupSHdegree()
        package = render(view, gaussians, pipe, background)
        loss = l1_loss(package["render"], photograph)
        loss.backward()
        if iteration < opt.densify_until_iter:
            gaussians.spread(grads)
            gaussians.thin_out(mask)
        gaussians.optimizer.step()
        if iteration in save_iterations:
            scene.save(iteration)
        torch.save((gaussians.capture(), iteration), f"{folder}/chkpnt{iteration}.pth")
"""
    + FLAGS
)


def fork(
    root: Path,
    *changes: tuple[str, str],
    values: str = "image, radii",
    settings: str = "",
    arguments: str = "",
    package: str = "diff_gaussian_rasterization",
    kernel: str = "",
    binding: str = "",
    script: str = "train.py",
) -> HostRepo:
    """A fork that an extra group and its methods' names tell from vanilla 3DGS.

    ``changes`` replace texts of its files; of ``values`` that the rasterizer returns, all but two
    go on by name; settings and arguments come after vanilla's; "" as kernel: it is not vendored.
    """
    from miniatures.skeletons import SETTINGS

    skeleton(root)
    (root / "train.py").unlink()
    further = [each for each in values.split(", ")[2:] if each != "_"]
    texts = {
        "scene/gaussian_model.py": MODEL,
        "gaussian_renderer/__init__.py": RENDER.format(
            package=package,
            settings=", ".join(f"{name}={int(name == 'scale_modifier')}" for name in SETTINGS)
            + settings,
            values=values,
            arguments=arguments,
            keys="".join(f', "{name}": {name}' for name in further),
        ),
        script: TRAIN,
    }
    for old, new in changes:
        assert any(old in text for text in texts.values()), old
        texts = {path: text.replace(old, new) for path, text in texts.items()}
    if kernel or binding:
        texts |= {
            f"submodules/a/{package}/__init__.py": binding,
            "submodules/a/forward.cu": KERNEL.replace("SUMS", kernel),
        }
    for name, text in texts.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return HostRepo(root)


LIMITS = """
if (p_view.z <= 0.2f) return;
if (alpha < 1.0f / 255.0f) continue;
if (test_T < 0.0001f) { done = true; }
"""
KERNEL = """
float power = -0.5f * (con_o.x * d.x * d.x + con_o.z * d.y * d.y) - con_o.y * d.x * d.y;
float alpha = min(0.99f, con_o.w * exp(power));
glm::mat3 J = glm::mat3(fx / t.z, 0.0f, -(fx * t.x) / (t.z * t.z),
    0.0f, fy / t.z, -(fy * t.y) / (t.z * t.z), 0, 0, 0);
cov[0][0] += 0.3f;
cov[1][1] += 0.3f;
LIMITS
SUMS
""".replace("LIMITS", LIMITS)
