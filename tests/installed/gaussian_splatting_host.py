"""How the conformance kit drives the pip packages of gaussian-splatting, as they are installed."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import torch

from fragprune_plugins.testing import Chance, Host
from fragprune_plugins.testing.host import FAINT, Action

NEVER = 10**9  # iterations: densifiers, resets and lifts wait for the kit's actions
DENSIFIER = {
    **dict.fromkeys(("densify_from_iter", "prune_from_iter", "opacity_reset_from_iter"), NEVER),
    "sh_degree_up_interval": NEVER,
}
SCENE = SimpleNamespace(scene_extent=lambda: 3.0)


def link(outermost: Any, name: str) -> Any:
    """The trainer or densifier of a class's name in a chain that wraps one another."""
    each = outermost
    while type(each).__name__ != name:
        each = getattr(each, "base_trainer", None) or getattr(each, "base_densifier", None)
    return each


@contextmanager
def at_once(owner: Any, **options: Any) -> Iterator[None]:
    """Inside, what a trainer or densifier does now and then is due."""
    kept = {name: getattr(owner, name) for name in options}
    vars(owner).update(options)
    try:
        yield
    finally:
        vars(owner).update(kept)


class GaussianSplattingHost(Host):
    """Trainers and densifiers that wrap one another, over a model that is a module."""

    package = "gaussian_splatting"
    lacks = {"checkpoint": "it has none: a run begins from a PLY"}  # noqa: RUF012
    routine = ("densify and prune", "reset opacity", "another band")

    def arguments(self) -> Any:
        return SimpleNamespace()

    def new_model(self, degree: int) -> Any:
        return import_module("gaussian_splatting").GaussianModel(degree).to("cuda")

    def fill(self, model: Any, cloud: Any) -> None:
        model.create_from_pcd(torch.tensor(cloud.points), torch.tensor(cloud.colors))

    def trainer(self, model: Any) -> Any:
        """The package's own, of which nothing is due."""
        trainers = import_module("gaussian_splatting.trainer")
        make = trainers.BaseOpacityResetDensificationTrainer
        return trainers.SHLiftTrainerWrapper(make, model, SCENE, **DENSIFIER)

    def model(self, arguments: Any, count: int, *, seed: int, degree: int, setup: bool) -> Any:
        model = super().model(arguments, count, seed=seed, degree=degree, setup=False)
        model.active_sh_degree = 0
        if setup:
            model.trainer = self.trainer(model)
        return model

    def camera(self, width: int, height: int, *, side: float = 0.0) -> Any:
        photograph = super().camera(width, height).original_image
        own = import_module("gaussian_splatting.camera").build_camera(
            *(height, width, 0.8, 0.6), R=torch.eye(3), T=torch.tensor([side, 0.0, 3.0])
        )
        own = own._replace(ground_truth_image=photograph)
        return SimpleNamespace(own=own, original_image=photograph)

    def render(self, camera: Any, model: Any, background: torch.Tensor) -> dict[str, Any]:
        package: dict[str, Any] = model(camera.own._replace(bg_color=background))
        return package

    def step(self, model: Any, camera: Any, iteration: int, background: torch.Tensor) -> float:
        loss, _ = model.trainer.step(camera.own._replace(bg_color=background))
        return float(loss.detach())

    def parameters(self, model: Any) -> dict[str, torch.Tensor]:
        groups = model.trainer.optimizer.param_groups
        return {group["name"]: group["params"][0] for group in groups}

    def actions(self) -> dict[str, Action]:
        return {
            "clone": lambda *given: densify(*given, densify_percent_dense=1e6),
            "split": lambda *given: densify(*given, densify_percent_dense=0.0),
            "prune": prune,
            "densify and prune": densify_and_prune,
            "reset opacity": reset_opacity,
            "another band": lambda model, arguments, chance: model.trainer.oneupSHdegree(),
        }


def rearrange(model: Any) -> None:
    """What every step does before its optimizer moves: ask the densifiers, and follow them."""
    count = len(model.get_xyz)
    nothing_seen = {
        "visibility_filter": torch.zeros(count, dtype=torch.bool),
        "radii": torch.zeros(count),
        "get_viewspace_grad": lambda out: torch.zeros(count, 3),
    }
    link(model.trainer, "DensificationTrainer").before_optim_hook(None, nothing_seen, None)


def densify(model: Any, arguments: Any, chance: Chance, **options: Any) -> None:
    """Clone or split those whose gradients on the screen are large."""
    count = len(model.get_xyz)
    chain = link(model.trainer, "DensificationTrainer").densifier
    densifier = link(chain, "BoundedSplitCloneDensifier")
    densifier.xyz_gradient_accum = chance.uniform(count, 1)
    densifier.denom = chance.rows(count, 0.8)[:, None].float()
    due = {"densify_from_iter": 0, "densify_interval": 1, "densify_target_lower_bound": 0}
    with at_once(densifier, densify_grad_threshold=1 - chance.share, **due, **options):
        rearrange(model)


def prune(model: Any, arguments: Any, chance: Chance) -> None:
    """Take away the faint and the large."""
    with pruning(model, chance):
        rearrange(model)


def densify_and_prune(model: Any, arguments: Any, chance: Chance) -> None:
    """Both at once, as one instruction."""
    with pruning(model, chance):
        densify(model, arguments, chance)


@contextmanager
def pruning(model: Any, chance: Chance) -> Iterator[None]:
    """Inside, the next rearrangement prunes; some rows are faint, some large."""
    count = len(model.get_xyz)
    chain = link(model.trainer, "DensificationTrainer").densifier
    pruner = link(chain, "OpacityPruner")
    pruner.max_radii2D = 25 * chance.uniform(count)
    with torch.no_grad():
        model._opacity[chance.rows(count, chance.share / 2)] = FAINT
    with at_once(pruner, prune_from_iter=0, prune_interval=1):
        yield


def reset_opacity(model: Any, arguments: Any, chance: Chance) -> None:
    """Only once the optimizer has stepped: the host fails before, and never does it so early."""
    resetter = link(model.trainer, "OpacityResetter")
    if model.trainer.optimizer.state:
        with at_once(resetter, opacity_reset_from_iter=0, opacity_reset_interval=1):
            resetter.optim_step()


class MCMCHost(GaussianSplattingHost):
    """The package that extends it: relocation, addition and noise."""

    package = "gaussian_splatting_mcmc"
    variant = "mcmc"
    routine = ("relocate and add", "noise")

    def trainer(self, model: Any) -> Any:
        trainers = import_module("gaussian_splatting_mcmc.trainer")
        nothing = import_module("gaussian_splatting.trainer").NoopDensifier
        waiting = {"relocate_from_iter": NEVER, "noise_lr": 1e3}
        return trainers.MCMCTrainerWrapper(nothing, model, SCENE, **waiting)

    def actions(self) -> dict[str, Action]:
        return {
            "relocate": lambda *given: relocate(*given, faint=True, more=0),
            "add": lambda *given: relocate(*given, faint=False, more=10),
            "relocate and add": lambda *given: relocate(*given, faint=True, more=10),
            "noise": noise,
        }


def relocate(model: Any, arguments: Any, chance: Chance, *, faint: bool, more: int) -> None:
    """Faint rows move onto others, and new ones come."""
    count = len(model.get_xyz)
    if faint:
        with torch.no_grad():
            model._opacity[chance.rows(count)] = FAINT
    relocater = link(link(model.trainer, "DensificationTrainer").densifier, "Relocater")
    due = {"densify_from_iter": 0, "densify_interval": 1}
    with at_once(relocater, cap_max=count + int(more * chance.share), **due):
        rearrange(model)


@torch.no_grad()
def noise(model: Any, arguments: Any, chance: Chance) -> None:
    """As every step ends."""
    link(model.trainer, "Noiser").add_noise(model, 1e-3)
