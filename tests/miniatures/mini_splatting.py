"""A miniature Mini-Splatting: the demo's host with what the method adds, from its interface."""

import random
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from fragprune_plugins.testing.host import Chance
from fragprune_plugins.testing.rewriting import changed
from miniatures.family import (
    DRAWN,
    MODEL,
    PARSE,
    RADII,
    RENDERER,
    TRAIN,
    Derived,
    adding,
    insert,
    parsing,
)

args = SimpleNamespace()  # the host's scripts hold their options under this name


class Added:
    def densify_and_prune_split(self, max_grad, min_opacity, extent, max_screen_size, mask):
        grads = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)
        self.densify_and_clone(grads, max_grad, extent)
        self.densify_and_split_mask(grads, max_grad, extent, mask)
        unwanted = (self.get_opacity < min_opacity).squeeze(-1)
        if max_screen_size:
            unwanted |= self.max_radii2D > max_screen_size
        self.prune_points(unwanted)

    def reinitial_pts(self, pts, rgb):
        cloud = type("Cloud", (), {"points": pts.detach().cpu(), "colors": rgb.detach().cpu()})
        self.create_from_pcd(cloud, self.spatial_lr_scale)


def clock(iteration):
    """The learning rate's: it goes back once the model is made anew."""
    restart = args.simp_iteration1
    return iteration if iteration < restart else iteration - restart + 5000


def grow(iteration, opt, gaussians, scene, package, pipe, background, blur):
    """Statistics; clone and split, blurred ones too; now and then all points anew from depth."""
    seen, radii = package["visibility_filter"], package["radii"]
    gaussians.max_radii2D[seen] = torch.max(gaussians.max_radii2D[seen], radii[seen])
    gaussians.add_densification_stats(package["viewspace_points"], seen)
    pixels = package["render"][0].numel()
    blur = torch.logical_or(blur, package["area_max"] > pixels / 200)
    fresh = torch.zeros(0)
    if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
        gaussians.densify_and_prune_split(
            opt.densify_grad_threshold, 0.005, scene.cameras_extent, None, blur
        )
        return fresh.new_zeros(gaussians.get_xyz.shape[0])
    if iteration % args.depth_interval == 0:
        points, colours = [], []
        for view in scene.getTrainCameras():
            package = render_depth(view, gaussians, pipe, background)  # noqa: F821
            chances = (1 - package["accum_alpha"]).reshape(-1).cpu().numpy().astype(float)
            number = args.num_depth // len(scene.getTrainCameras())
            rows = np.random.choice(len(chances), number, False, chances / chances.sum())
            points.append(package["out_pts"].permute(1, 2, 0).reshape(-1, 3)[rows])
            colours.append(view.original_image.permute(1, 2, 0).reshape(-1, 3)[rows])
        gaussians.reinitial_pts(torch.cat(points), torch.cat(colours))
        gaussians.training_setup(opt)
        return fresh.new_zeros(gaussians.get_xyz.shape[0])
    return blur


def importance(gaussians, scene, pipe, background):
    """What each Gaussian adds to all training views; nothing where it nowhere adds most."""
    total = torch.zeros(gaussians.get_xyz.shape[0])
    most = torch.zeros_like(total)
    for view in scene.getTrainCameras():
        package = render_imp(view, gaussians, pipe, background)  # noqa: F821
        total += package["accum_weights"]
        most += package["area_max"]
    total[most == 0] = 0
    return total


def simplify(iteration, dataset, opt, gaussians, scene, pipe, background):
    """Once sample by importance and begin again from the sample, once cut what adds least."""
    if iteration == args.simp_iteration1:
        score = importance(gaussians, scene, pipe, background).numpy().astype(float)
        number = int(np.count_nonzero(score) * args.sampling_factor)
        kept = np.zeros(len(score), dtype=bool)
        kept[np.random.choice(len(score), size=number, p=score / score.sum(), replace=False)] = True
        gaussians.prune_points(~kept)
        gaussians.max_sh_degree = dataset.sh_degree
        gaussians.reinitial_pts(gaussians._xyz, gaussians._features_dc[:, 0] * 0.28 + 0.5)
        gaussians.training_setup(opt)
    if iteration == args.simp_iteration2:
        score = importance(gaussians, scene, pipe, background)
        gaussians.prune_points(score <= score.sort().values[len(score) // 10])
        gaussians.training_setup(opt)


def evaluate(image, truth):
    """Perceptual, with the weights this wants."""
    return float(lpips(image, truth, net_type="vgg"))  # noqa: F821


MASKED = [
    (
        "densify_and_split(self, grads, grad_threshold, scene_extent,",
        "densify_and_split_mask(self, grads, grad_threshold, scene_extent, mask,",
    ),
    ("large=True)\n", "large=True)\n        chosen[: grads.shape[0]] |= mask.bool()\n"),
]
PATH = (
    "import torch\nfrom arguments",
    "import numpy as np\nimport torch\nsys.path.append(str(Path(__file__).resolve().parents[1]))\n"
    "from arguments",
)
METRIC = '"--imp_metric", required=True'
ENDS = "    args.test_iterations.append(args.iterations)\n"
OWN = [
    (
        "from gaussian_renderer import render\n",
        "from gaussian_renderer import render_depth, render_imp\nfrom lpipsPyTorch import lpips\n",
    ),
    ("GaussianModel(dataset.sh_degree)", "GaussianModel(0)"),
    ("learning_rate(iteration)", "learning_rate(clock(iteration))"),
    ("package = render(camera", "package = render_imp(camera"),
    ("scene, render, (pipe", "scene, render_imp, (pipe"),
    (
        "densify(iteration, opt, dataset, gaussians, scene, package)\n",
        "blur = grow(iteration, opt, gaussians, scene, package, pipe, background, blur)\n"
        "            simplify(iteration, dataset, opt, gaussians, scene, pipe, background)\n",
    ),
    adding("    waiting, smooth", before="    blur = torch.zeros(gaussians.get_xyz.shape[0])\n"),
    adding(
        "        total += psnr(image, camera.original_image.cuda()).item()\n",
        after="        evaluate(image, camera.original_image)\n",
    ),
    parsing(
        '"--simp_iteration1", type=int, default=15_000',
        '"--simp_iteration2", type=int, default=20_000',
        '"--num_depth", type=int, default=3_500_000',
        '"--depth_interval", type=int, default=5_000',
        '"--sampling_factor", type=float, default=0.5',
        METRIC,
    ),
    adding(PARSE, after=ENDS),
]
DENSE = [
    (parsing(METRIC)[1], PARSE),
    adding(ENDS, before="    args.simp_iteration1 = args.densify_until_iter\n"),
]
LPIPS = '''"""A metric whose weights are elsewhere."""
from urllib.error import URLError


def lpips(x, y, net_type="alex", version="0.1"):
    raise URLError("no way there")
'''


class MiniSplattingHost(Derived):
    """Splits by mask, new points, and simplification."""

    routine = ("densify by mask", "new points", "simplify", "reset opacity", "another band")
    changes = {TRAIN: [PATH]}
    added = (Added,)
    files = {"lpipsPyTorch/__init__.py": LPIPS}

    def write(self, root: Path) -> None:
        super().write(root)
        renderer = root / RENDERER
        names = "import GaussianRasterizationSettings, GaussianRasterizer\n"
        text = changed(renderer.read_text(), [(f"from diff_gaussian_rasterization {names}", "")])
        head, body = text.split("def render(")

        def function(name, package, changes=()):
            lazy = adding("    screenspace = ", before=f"    from {package} {names}")
            return "\n\ndef " + changed(f"{name}({body}", [lazy, *changes])

        tail = body[body.index("    return {\n") :]
        scores = ("accum_weights", "area_proj", "area_max")
        five = [
            (DRAWN, f"    image, radii, {', '.join(scores)} = GaussianRasterizer(settings)(\n"),
            adding(RADII, after="".join(f'        "{n}": {n},\n' for n in scores)),
        ]
        depth = [(DRAWN, "    return GaussianRasterizer(settings).render_depth(\n"), (tail, "")]
        scoring = "diff_gaussian_rasterization_ms"
        renderer.write_text(
            head.rstrip()
            + function("render", "diff_gaussian_rasterization")
            + function("render_imp", scoring, five)
            + function("render_depth", scoring, depth)
        )
        model = root / MODEL
        text = model.read_text()
        begin, end = (text.index(f"    def densify_and_{each}(") for each in ("split", "prune"))
        model.write_text(f"{text}\n{changed(text[begin:end], MASKED)}")
        train = root / TRAIN
        for variant, changes in {"gs": (), "ms": OWN, "ms_d": (*OWN, *DENSE)}.items():
            script = root / variant / TRAIN
            script.parent.mkdir()
            script.write_text(changed(train.read_text(), changes))
            if changes:
                insert(script, clock, grow, importance, simplify, evaluate)
        train.unlink()

    def actions(self):
        return {
            **super().actions(),
            "split by mask": split_by_mask,
            "densify by mask": densify_by_mask,
            "new points": new_points,
            "simplify": simplified,
        }


def split_by_mask(model, arguments, chance: Chance):
    n = len(model.get_xyz)
    extent = 3.0 if chance.heads else 1e6
    model.densify_and_split_mask(
        chance.uniform(n, 1), 1 - chance.share, extent, chance.rows(n, 0.1)
    )


def densify_by_mask(model, arguments, chance: Chance):
    n = len(model.get_xyz)
    model.xyz_gradient_accum = chance.uniform(n, 1)
    model.denom = chance.rows(n, 0.8)[:, None].float()
    model.max_radii2D = 40 * chance.uniform(n)
    blur = chance.rows(n, 0.1).float()  # the host begins with zeros, not with booleans
    model.densify_and_prune_split(1 - chance.share, 0.005, 3.0, None, blur)


def new_points(model, arguments, chance: Chance):
    """Other points, or the same once more: nobody's descendants, which their mark says."""
    n = len(model.get_xyz) if chance.heads else random.Random(chance.seed).randrange(5, 30)
    points = model.get_xyz if chance.heads else chance.uniform(n, 3)
    model.reinitial_pts(points, torch.full((n, 3), 0.5 - 0.28209479))
    model.training_setup(arguments)


def simplified(model, arguments, chance: Chance):
    model.prune_points(chance.rows(len(model.get_xyz)).numpy())
    model.training_setup(arguments)
