"""A miniature Speedy-Splat: the demo's host with what the method adds, from its interface."""

import inspect
from pathlib import Path
from types import SimpleNamespace

import torch

from fragprune_plugins.testing.host import Chance, Host
from fragprune_plugins.testing.rewriting import rewrite
from miniatures.mini_splatting import LPIPS

args = SimpleNamespace()  # the hosts' scripts hold their options under this name

RENDERER, TRAIN = "gaussian_renderer/__init__.py", "train.py"
DRAW = "    image, radii = GaussianRasterizer(raster_settings=settings)(\n"
STEP = "            if iteration < opt.iterations:\n"
PARSE = "    args = parser.parse_args()\n"


class Pruning:
    """What the models of both pruning methods have besides."""

    def prune_gaussians(self, percent, import_score):
        lowest = import_score.sort(dim=0).values[int(percent * (len(import_score) - 1))]
        self.prune_points((import_score <= lowest).squeeze())

    def get_opacity_and_scales_for_train(self):
        return self.get_opacity, self.get_scaling


def prune(iteration, gaussians, scene, pipe, background):
    """Now and then, the Gaussians whose squared gradients are least go."""
    if iteration >= args.prune_until_iter or iteration % args.prune_interval:
        return
    scores = torch.zeros_like(gaussians.get_opacity)
    with torch.enable_grad():
        for view in scene.getTrainCameras():
            each = torch.zeros_like(scores).requires_grad_()
            render(view, gaussians, pipe, background, scores=each)["render"].sum().backward()  # noqa: F821
            scores += each.grad
    gaussians.prune_gaussians(0.3, scores)


SPEEDY = {
    RENDERER: [
        ("    bg_color: torch.Tensor,\n", "    bg_color: torch.Tensor,\n    scores=None,\n"),
        (
            DRAW,
            "    scores = torch.zeros_like(pc.get_opacity) if scores is None else scores\n"
            + DRAW.replace("radii", "radii, kernel_times"),
        ),
        ("opacities=pc.get_opacity,", "opacities=pc.get_opacity, scores=scores,"),
        ('"radii": radii,\n', '"radii": radii,\n        "kernel_times": kernel_times,\n'),
    ],
    TRAIN: [
        (STEP, "            prune(iteration, gaussians, scene, pipe, background)\n" + STEP),
        (
            PARSE,
            '    parser.add_argument("--prune_until_iter", type=int, default=30_000)\n'
            '    parser.add_argument("--prune_interval", type=int, default=3_000)\n' + PARSE,
        ),
        (
            'image = renderFunc(camera, scene.gaussians, *renderArgs)["render"].clamp(0, 1)\n',
            "package = renderFunc(camera, scene.gaussians, *renderArgs)\n"
            '        1000 / package["kernel_times"][-1].item()\n'
            '        image = package["render"].clamp(0, 1)\n',
        ),
        ('if __name__ == "__main__"', inspect.getsource(prune) + '\n\nif __name__ == "__main__"'),
    ],
}


class SpeedyHost(Host):
    """Pruning by a score."""

    routine = ("prune by score", "densify and prune", "reset opacity", "another band")

    def write(self, root: Path) -> None:
        super().write(root)
        rewrite(root, SPEEDY, Pruning)
        (root / "lpipsPyTorch").mkdir()
        (root / "lpipsPyTorch/__init__.py").write_text(LPIPS)

    def actions(self):
        return {**super().actions(), "prune by score": prune_by_score}


def prune_by_score(model, arguments, chance: Chance):
    model.prune_gaussians(chance.share, chance.uniform(len(model.get_xyz)))
