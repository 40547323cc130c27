"""A miniature LP-3DGS: the demo's host with what the method adds, from its interface."""

from fragprune_plugins.testing.host import densify_and_prune
from miniatures.family import DRAWN, MODEL, PARSE, RENDERER, SCENE, STEP, TRAIN, Derived, adding
from miniatures.mini_splatting import LPIPS
from miniatures.speedy_splat import Pruning

POOLED = """from scene.gaussian_model import GaussianModel


class {name}(GaussianModel):
    def oneupSHdegree(self, opt, iteration):
        super().oneupSHdegree(opt, iteration)

    def prune_after_render(self, iteration, scene, pipe, render):
        if iteration == 12:
            score = 0
            for view in scene.getTrainCameras():
                package = render(view, self, pipe, view.original_image.new_zeros(3), {score}=True)
                score = score + package["important_score"]
            self.prune_gaussians(0.3, score)
"""


class LPHost(Derived):
    """Models to choose from, and a script that ends by rendering and evaluating."""

    flags = ('"--prune_method", default="3dgs"',)
    settings = {"f_count": False, "bw_score": False, "mw_score": False, "top_K_dT": None}
    changes = {
        RENDERER: [
            adding("    override_color=None,\n", after="    test=False,\n"),
            (
                DRAWN,
                "    opacity, _ = pc.get_opacity_and_scales_for_train()\n"
                "    result = GaussianRasterizer(raster_settings=settings)(\n",
            ),
            ("opacities=pc.get_opacity,", "opacities=opacity,"),
            (
                "    return {\n",
                "    image, radii, count, score = result\n    return {\n"
                '        "gaussians_count": count,\n        "important_score": score,\n',
            ),
        ],
        MODEL: [
            (
                "    def oneupSHdegree(self):",
                "    def prune_after_render(self, *args):\n        pass\n\n"
                "    def oneupSHdegree(self, opt, iteration):",
            ),
            ("extent, max_screen_size):", "extent, max_screen_size, n_split, opt=None):"),
        ],
        SCENE: [
            adding(
                "from scene.gaussian_model import GaussianModel\n",
                after="from scene.gaussian_model_mini_splatting import MiniSplatting\n"
                "from scene.gaussian_model_rad_splat import RadSplat\n",
            ),
            adding(
                "class Scene:\n",
                before='ModelPool = {"3dgs": GaussianModel, "mini_splatting": MiniSplatting, '
                '"rad_splat": RadSplat}\n\n\n',
            ),
        ],
        TRAIN: [
            adding("import torch\n", after="import wandb\n"),
            ("from scene import GaussianModel, Scene\n", "from scene import ModelPool, Scene\n"),
            ("GaussianModel(dataset", "ModelPool[args.prune_method](dataset"),
            ("gaussians.oneupSHdegree()", "gaussians.oneupSHdegree(opt, iteration)"),
            ("scene.cameras_extent, largest)", "scene.cameras_extent, largest, 1, opt=opt)"),
            adding(
                STEP,
                before="            gaussians.prune_after_render(iteration, scene, pipe, render)\n",
            ),
            adding(PARSE, after='    wandb.init(config=None, project="test").sweep_id\n'),
            adding(
                "        args.debug_from,\n    )\n",
                after="    from metrics import evaluate\n    from render import render_sets\n\n"
                '    render_sets(lp.extract(args), -1, pp.extract(args), False, False)["train"]\n'
                '    score = evaluate([args.model_path])[args.model_path]["ours_30000"]["PSNR"]\n'
                '    wandb.log({"psnr": score})\n',
            ),
        ],
    }
    added = (Pruning,)
    files = {
        "scene/gaussian_model_mini_splatting.py": POOLED.format(
            name="MiniSplatting", score="bw_score"
        ),
        "scene/gaussian_model_rad_splat.py": POOLED.format(name="RadSplat", score="mw_score"),
        "render.py": "from gaussian_renderer import render  # noqa: F401\n\n\n"
        "def render_sets(dataset, iteration, pipe, skip_train, skip_test):\n"
        '    return {"train": 1.0, "test": 1.0}\n',
        "metrics.py": "def evaluate(model_paths):\n    return {p: {} for p in model_paths}\n",
        "lpipsPyTorch/__init__.py": LPIPS,
    }

    def actions(self):
        return {
            **super().actions(),
            "densify and prune": lambda *given: densify_and_prune(*given, 1),
            "another band": lambda model, arguments, chance: model.oneupSHdegree(arguments, 1000),
        }
