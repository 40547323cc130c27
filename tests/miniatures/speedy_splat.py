"""A miniature Speedy-Splat: the demo's host with what the method adds, from its interface."""

from types import SimpleNamespace

import torch

from fragprune_plugins.testing.host import Chance
from miniatures.family import RENDERER, STEP, TRAIN, Derived, adding
from miniatures.mini_splatting import LPIPS

args = SimpleNamespace()  # the hosts' scripts hold their options under this name


class Pruning:
    """What the models of pruning methods have besides."""

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


class SpeedyHost(Derived):
    """Pruning by a score."""

    routine = ("prune by score", "densify and prune", "reset opacity", "another band")
    flags = (
        '"--prune_until_iter", type=int, default=30_000',
        '"--prune_interval", type=int, default=3_000',
    )
    values = ("kernel_times",)
    changes = {
        RENDERER: [
            adding("    bg_color: torch.Tensor,\n", after="    scores=None,\n"),
            adding(
                "    rasterizer = Gauss",
                before="    if scores is None:\n"
                "        scores = torch.zeros_like(pc.get_opacity)\n",
            ),
            adding("opacities=pc.get_opacity,", after=" scores=scores,"),
        ],
        TRAIN: [
            adding(
                STEP, before="            prune(iteration, gaussians, scene, pipe, background)\n"
            ),
            (
                'image = renderFunc(camera, scene.gaussians, *renderArgs)["render"].clamp(0, 1)\n',
                "package = renderFunc(camera, scene.gaussians, *renderArgs)\n"
                '        1000 / package["kernel_times"][-1].item()\n'
                '        image = package["render"].clamp(0, 1)\n',
            ),
        ],
    }
    functions = (prune,)
    added = (Pruning,)
    files = {"lpipsPyTorch/__init__.py": LPIPS}

    def actions(self):
        return {**super().actions(), "prune by score": prune_by_score}


def prune_by_score(model, arguments, chance: Chance):
    model.prune_gaussians(chance.share, chance.uniform(len(model.get_xyz)))
