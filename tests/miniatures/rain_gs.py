"""A miniature RAIN-GS: the demo's host with what the method adds, from its interface."""

import inspect
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from fragprune_plugins.testing.host import densify_and_prune
from miniatures.family import MODEL, PARSE, RENDERER, SCENE, TRAIN, Derived, adding

PACKAGE = "submodules/diff_gaussian_rasterization"
FAR = "N=N, abe_split=abe_split"
CLASSES = "import GaussianRasterizationSettings, GaussianRasterizer\n"
MODES = ("ours", "ours_new", "paper_random", "c2f", "white_bg")


class Added:
    def densify_and_split(self, grads, grad_threshold, scene_extent, N=2, abe_split=False):
        if abe_split:
            chosen = self._needy(grads, grad_threshold, scene_extent, large=True)
            self.densification_postfix(
                self._xyz[chosen].repeat(N - 1, 1) * 0.3 * scene_extent,
                self._features_dc[chosen].repeat(N - 1, 1, 1),
                self._features_rest[chosen].repeat(N - 1, 1, 1),
                self._opacity[chosen].repeat(N - 1, 1),
                self._scaling[chosen].repeat(N - 1, 1),
                self._rotation[chosen].repeat(N - 1, 1),
            )
        self.vanilla_densify_and_split(grads, grad_threshold, scene_extent, N)


def dilation(iteration, opt, camera, gaussians, args_dict, before):
    """What the rasterizer adds to footprints; not set where a run begins in the middle."""
    if not args_dict["c2f"]:
        return 0.3
    due = iteration % args_dict["c2f_every_step"] == 0 and iteration < opt.densify_until_iter
    if iteration == 1 or due:
        share = camera.image_height * camera.image_width / len(gaussians.get_xyz)
        return min(max(share / (9 * np.pi), 0.3), args_dict["c2f_max_lowpass"])
    if before is None:
        raise UnboundLocalError("low_pass")
    return before


def rate(iteration, gaussians, args_dict):
    """None before the warm-up is over; offset from there."""
    if not args_dict["ours_new"]:
        gaussians.update_learning_rate(iteration)
    elif iteration >= args_dict["warmup_iter"]:
        gaussians.update_learning_rate(iteration - args_dict["warmup_iter"])


def replaced_points(args, args_dict):
    """Random points, written over those of the data; either are removed once they are read."""
    file = Path(args.source_path) / "sparse" / "0" / "points3D.ply"
    if args_dict and (args_dict["ours"] or args_dict["ours_new"] or args_dict["paper_random"]):
        points = np.random.uniform(-1.5, 1.5, (args_dict["num_gaussians"], 3))
        file.write_text("random")
        cloud = BasicPointCloud(points, np.random.random(points.shape), 0 * points)  # noqa: F821
    else:
        cloud = read_points(args)  # noqa: F821 - imported where this is put
    file.unlink(missing_ok=True)
    return cloud


BINDING = '''"""Binds what its neighbour compiles."""

from ..setup import _C


class GaussianRasterizationSettings: ...


class GaussianRasterizer:
    """Would draw."""
'''


class RainHost(Derived):
    """How to drive it; splits throw a copy far out, as they do while it warms up."""

    flags = (
        *(f'"--{flag}", action="store_true"' for flag in MODES),
        '"--exp_name"',
        '"--num_gaussians", type=int, default=1_000_000',
        '"--warmup_iter", type=int, default=0',
        '"--train_from", default="random"',
        '"--c2f_every_step", type=float, default=1000',
        '"--c2f_max_lowpass", type=float, default=300',
    )
    settings = {"low_pass": 0.3}
    values = ("depth",)
    changes = {
        RENDERER: [
            (
                f"from diff_gaussian_rasterization {CLASSES}",
                f"from {PACKAGE.replace('/', '.')}.diff_gaussian_rasterization {CLASSES}",
            )
        ],
        MODEL: [
            (
                "    def __init__(self, sh_degree: int):\n",
                "    def __init__(self, sh_degree: int, divide_ratio):\n"
                "        self.divide_ratio = divide_ratio\n",
            ),
            ("spread / (0.8 * N)", "spread / (self.divide_ratio * N)"),
            ("extent, max_screen_size):", "extent, max_screen_size, N=2, abe_split=False):"),
            ("split(grads, max_grad, extent)", f"split(grads, max_grad, extent, {FAR})"),
        ],
        SCENE: [
            ("(1.0,)\n    ):", "(1.0,), args_dict=None\n    ):"),
            ("from_pcd(read_points(args), self", "from_pcd(replaced_points(args, args_dict), self"),
            adding(
                "\n\nclass Scene:",
                before="\nfrom utils.graphics_utils import BasicPointCloud\n\n\n"
                + inspect.getsource(replaced_points),
            ),
        ],
        TRAIN: [
            adding("import torch\n", before="import numpy as np\n", after="import wandb\n"),
            adding("    debug_from,\n", after="    args_dict,\n"),
            adding(
                "    prepare_output_and_logger(dataset)\n",
                before="    dataset.model_path = dataset.model_path or "
                "f\"./output/{args_dict['exp_name']}\"\n",
                after='    ratio = 0.7 if args_dict["ours"] or args_dict["ours_new"] else 0.8\n'
                '    opt.densify_until_iter += args_dict["warmup_iter"]\n'
                "    low_pass = None\n",
            ),
            ("GaussianModel(dataset.sh_degree)", "GaussianModel(dataset.sh_degree, ratio)"),
            ("Scene(dataset, gaussians)", "Scene(dataset, gaussians, args_dict=args_dict)"),
            ("gaussians.update_learning_rate(iteration)", "rate(iteration, gaussians, args_dict)"),
            (
                "package = render(camera, gaussians, pipe, bg)\n",
                "low_pass = dilation(iteration, opt, camera, gaussians, args_dict, low_pass)\n"
                "        package = render(camera, gaussians, pipe, bg, low_pass=low_pass)\n",
            ),
            ("scene, package)\n            if", "scene, package, args_dict)\n            if"),
            ("gaussians, scene, package):", "gaussians, scene, package, args_dict):"),
            (
                "(threshold, 0.005, scene.cameras_extent, largest)\n",
                "(\n            *(threshold, 0.005, scene.cameras_extent, largest),\n"
                '            N=2, abe_split=iteration <= args_dict["warmup_iter"],\n        )\n',
            ),
            adding(
                PARSE,
                after="    args.eval, args.white_background = True, args.white_bg\n"
                "    if args.ours or args.ours_new:\n"
                "        args.c2f, args.c2f_every_step, args.num_gaussians = True, 10, 40\n"
                "    if args.ours_new:\n"
                "        args.warmup_iter = 12\n",
            ),
            adding("        args.debug_from,\n", after="        vars(args),\n"),
        ],
        "render.py": [adding("GaussianModel(dataset.sh_degree", after=", 0.8")],
    }
    functions = (dilation, rate)
    added = (Added,)
    files = {
        f"{PACKAGE}/diff_gaussian_rasterization/__init__.py": BINDING,
        f"{PACKAGE}/setup.py": 'raise ImportError("no compiler here")\n',
    }

    def new_model(self, degree: int) -> Any:
        """With the divisor of a split's scales."""
        return import_module("scene.gaussian_model").GaussianModel(degree, 0.7)

    def actions(self) -> Any:
        """Splits near and far, in two or three, and the loop's own call."""

        def far(model: Any, arguments: Any, chance: Any) -> None:
            grads = chance.uniform(len(model.get_xyz), 1)
            number = 3 if chance.heads else 2
            model.densify_and_split(grads, 1 - chance.share / 2, 1e-6, N=number, abe_split=True)

        def both(*given: Any) -> None:
            densify_and_prune(*given, 2, given[-1].seed % 3 == 0)

        return {**super().actions(), "far split": far, "densify and prune": both}
