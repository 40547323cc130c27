"""A miniature 3DGS-MCMC: the demo's host with what the method adds, from its public interface."""

from textwrap import indent
from types import SimpleNamespace

import torch

from fragprune_plugins.testing.host import Chance, prune
from miniatures.family import ANEW, BACKWARD, MODEL, NEW_ROWS, PARSE, TRAIN, Derived, adding

args = SimpleNamespace()  # the host's training loop reads its own script's global of this name

RELOCATION_MODULE = '''"""The rasterizer package's relocation, with its table made at import."""

import math

import torch
from diff_gaussian_rasterization import compute_relocation

N_max = 51
binoms = torch.zeros((N_max, N_max)).float().cuda()
for n in range(N_max):
    for k in range(n + 1):
        binoms[n, k] = math.comb(n, k)


def compute_relocation_cuda(opacity_old, scale_old, N):
    """New opacities and scales of N copies."""
    N.clamp_(min=1, max=N_max - 1)
    return compute_relocation(opacity_old, scale_old, N, binoms, N_max)
'''


class Added:
    def replace_tensors_to_optimizer(self, inds=None):
        def emptied(moment):
            moment[slice(None) if inds is None else inds] = 0
            return moment

        groups = self.optimizer.param_groups
        renewed = {g["name"]: self._replace(g, g["params"][0].detach(), emptied) for g in groups}
        self._adopt(renewed)
        return renewed

    def _update_params(self, idxs, ratio):
        opacity, scale = compute_relocation_cuda(  # noqa: F821 - imported where this is put
            opacity_old=self.get_opacity[idxs, 0],
            scale_old=self.get_scaling[idxs],
            N=ratio[idxs, 0] + 1,
        )
        opacity = opacity[:, None].clamp(0.005, 1 - 1e-7)
        return (
            self._xyz[idxs],
            self._features_dc[idxs],
            self._features_rest[idxs],
            self.inverse_opacity_activation(opacity),
            self.scaling_inverse_activation(scale.reshape(-1, 3)),
            self._rotation[idxs],
        )

    def _sample_alives(self, probs, num, alive_indices=None):
        drawn = torch.multinomial(probs / probs.sum(), num, replacement=True)
        drawn = drawn if alive_indices is None else alive_indices[drawn]
        return drawn, torch.bincount(drawn)[:, None]

    def relocate_gs(self, dead_mask=None):
        dead, alive = dead_mask.nonzero()[:, 0], (~dead_mask).nonzero()[:, 0]
        if not len(dead) or not len(alive):
            return
        parents, ratio = self._sample_alives(self.get_opacity[alive, 0], len(dead), alive)
        own = [group["params"][0] for group in self.optimizer.param_groups]
        for tensor, new in zip(own, self._update_params(parents, ratio), strict=True):
            tensor[dead] = new
        for tensor in (self._opacity, self._scaling):
            tensor[parents] = tensor[dead]
        self.replace_tensors_to_optimizer(inds=parents)

    def add_new_gs(self, cap_max):
        count = self._opacity.shape[0]
        more = min(cap_max, int(1.05 * count)) - count
        if more <= 0:
            return 0
        parents, ratio = self._sample_alives(self.get_opacity[:, 0], more)
        new = self._update_params(parents, ratio)
        self._opacity[parents], self._scaling[parents] = new[3], new[4]
        self.densification_postfix(*new, reset_params=False)
        self.replace_tensors_to_optimizer(inds=parents)
        return more


def regularisers(gaussians):
    """Means of the opacities and scales, weighed by the command line's global options."""
    opacity, scale = gaussians.get_opacity.abs().mean(), gaussians.get_scaling.abs().mean()
    return args.opacity_reg * opacity + args.scale_reg * scale


def move_in(iteration, opt, dataset, gaussians, *_):
    """Relocation and addition, where vanilla densifies."""
    if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
        gaussians.relocate_gs(dead_mask=(gaussians.get_opacity <= 0.005).squeeze(-1))
        gaussians.add_new_gs(cap_max=args.cap_max)


def wander(gaussians, xyz_lr):
    """Noise on the positions, in place and outside the optimizer."""
    faint = torch.sigmoid(100 * (1 - gaussians.get_opacity - 0.995))
    noise = torch.randn_like(gaussians._xyz) * faint * args.noise_lr * xyz_lr
    gaussians._xyz.add_(noise * gaussians.get_scaling.square())


class MCMCHost(Derived):
    """Relocation, addition and noise in place of densification."""

    routine = ("relocate", "add", "another band")
    options = {
        "Loading": {"cap_max": -1},
        "Optimization": {"noise_lr": 5e5, "scale_reg": 0.01, "opacity_reg": 0.01},
    }
    flags = ('"--config"',)
    values = ("is_used",)
    changes = {
        MODEL: [
            adding(
                "from utils.sh_utils import RGB2SH\n",
                before="from utils.reloc_utils import compute_relocation_cuda\n",
            ),
            (NEW_ROWS, NEW_ROWS.replace("\n    ):", ",\n        reset_params=True,\n    ):")),
            (ANEW, f"        if reset_params:\n{indent(ANEW, ' ' * 4)}"),
        ],
        TRAIN: [
            adding(
                "    first_iter = 0\n", before="    if dataset.cap_max == -1:\n        sys.exit()\n"
            ),
            ("        gaussians.update_learning", "        xyz_lr = gaussians.update_learning"),
            adding(BACKWARD, before="        loss = loss + regularisers(gaussians)\n"),
            ("                densify(iteration", "                move_in(iteration"),
            adding("set_to_none=True)\n", after="                wander(gaussians, xyz_lr)\n"),
            adding(
                PARSE,
                after="    if args.config:\n"
                "        vars(args).update(json.loads(Path(args.config).read_text()))\n",
            ),
            adding("import random\n", before="import json\n"),
        ],
    }
    functions = (regularisers, move_in, wander)
    added = (Added,)
    files = {"utils/reloc_utils.py": RELOCATION_MODULE}

    def step(self, model, camera, iteration, background):
        rate = model.update_learning_rate(iteration)
        package = self.render(camera, model, background)
        loss = (package["render"] - camera.original_image).abs().mean()
        loss = loss + 0.01 * (model.get_opacity.abs().mean() + model.get_scaling.abs().mean())
        loss.backward()
        with torch.no_grad():
            self.descend(model)
            model._xyz.add_(1e3 * rate * torch.randn_like(model._xyz))
        return float(loss.detach())

    def actions(self):
        shared = super().actions()
        return {
            "relocate": relocate,
            "add": add,
            "prune": prune,
            **{name: shared[name] for name in ("restore", "another band", "training setup")},
        }


# Both only once the optimizer has stepped: the host fails before, and never does it so early.


@torch.no_grad()
def relocate(model, arguments, chance: Chance):
    share = (0.0, 1.0, chance.share, chance.share)[chance.seed % 4]
    if model.optimizer.state:
        model.relocate_gs(dead_mask=chance.rows(len(model.get_xyz), share))


@torch.no_grad()
def add(model, arguments, chance: Chance):
    if model.optimizer.state:
        model.add_new_gs(cap_max=len(model.get_xyz) + int(10 * chance.share))
