"""How the conformance kit drives gsplat, as it is installed."""

import math
import os
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from fragprune_gsplat import KEYS, NAMES
from fragprune_plugins.adapting import HostRepo, read_ply
from fragprune_plugins.injection.session import active_session
from fragprune_plugins.testing import Chance, Host
from fragprune_plugins.testing.host import FAINT, Action


def releases() -> dict[str, Path]:
    """The folders that hold gsplat: the installed one's, and those in ``FRAGPRUNE_HOSTS``."""
    installed, others = HostRepo.installed("gsplat"), os.environ.get("FRAGPRUNE_HOSTS")
    found = {"installed": installed.root} if installed else {}
    for folder in sorted(Path(others).iterdir()) if others else ():
        if HostRepo(folder).path("gsplat"):
            found[folder.name] = folder
    return found


def new_params(count, *, seed=0, degree=1):
    """(params, optimizers), as users of gsplat make them."""
    generator = torch.Generator().manual_seed(seed)

    def spread(*shape: int) -> torch.Tensor:
        return 2 * torch.rand(*shape, generator=generator) - 1

    tensors = {
        "means": spread(count, 3) * torch.tensor([0.9, 0.6, 0.5]),
        "scales": 0.25 * spread(count, 3) - 1.75,
        "quats": spread(count, 4),
        "opacities": torch.linspace(-1.7, 3.9, count),
        "sh0": 0.5 + 0.5 * spread(count, 1, 3),
        "shN": 0.2 * spread(count, (degree + 1) ** 2 - 1, 3),
    }
    params = torch.nn.ParameterDict({k: torch.nn.Parameter(v) for k, v in tensors.items()})
    return params, {k: torch.optim.Adam([p], lr=1e-2) for k, p in params.items()}


def axes() -> tuple[int, ...]:
    """What follows a Gaussian's row in the shape of radii: nothing until 1.4."""
    version: str = import_module("gsplat").__version__
    return () if version < "1.5" else (2,)


def draw(params: Any, **options: Any) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """The library's own function, with the arguments that every call of it has."""
    given = {
        "means": params["means"],
        "quats": params["quats"],
        "scales": params["scales"].exp(),
        "opacities": params["opacities"].sigmoid(),
        "colors": torch.cat([params["sh0"], params["shN"]], dim=1),
        "sh_degree": math.isqrt(1 + params["shN"].shape[1]) - 1,
        "packed": False,
    }
    drawn: tuple[torch.Tensor, torch.Tensor, dict[str, Any]]
    drawn = import_module("gsplat").rasterization(**{**given, **options})
    return drawn


class GsplatHost(Host):
    """A dict of parameters, an optimizer for each, and functions that change rows."""

    package = "gsplat"
    lacks = {"checkpoint": "it has none: users save the parameters, and thresholds beside them"}  # noqa: RUF012
    draws_alone = False  # its kernels are for CUDA alone, and its rasterizer no compiled package
    opacity = frozenset({"opacities"})
    colour = frozenset({"sh0", "shN"})
    routine = ("default strategy", "mcmc strategy", "split", "reset opacity", "noise")

    def arguments(self) -> Any:
        return SimpleNamespace()

    def model(self, arguments: Any, count: int, *, seed: int, degree: int, setup: bool) -> Any:
        model, optimizers = new_params(count, seed=seed, degree=degree)
        model.optimizers = optimizers
        if setup:
            import_module("gsplat").DefaultStrategy().check_sanity(model, optimizers)
        return model

    def camera(self, width: int, height: int, *, side: float = 0.0) -> Any:
        viewmats = torch.eye(4)[None].clone()
        viewmats[0, 0, 3], viewmats[0, 2, 3] = side, 3.0
        fx, fy = width / (2 * math.tan(0.4)), height / (2 * math.tan(0.3))
        Ks = torch.tensor([[[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]]])
        pixels = np.random.default_rng(7).random((3, height, width), dtype=np.float32)
        view = {"viewmats": viewmats, "Ks": Ks, "width": width, "height": height}
        return SimpleNamespace(view=view, original_image=torch.from_numpy(pixels))

    def render(self, camera: Any, model: Any, background: torch.Tensor) -> dict[str, Any]:
        colors, _, info = draw(model, backgrounds=background[None], **camera.view)
        return {"render": colors[0].permute(2, 0, 1), "radii": info["radii"]}

    def step(self, model: Any, camera: Any, iteration: int, background: torch.Tensor) -> float:
        image = self.render(camera, model, background)["render"]
        loss = (image - camera.original_image).abs().mean()
        loss.backward()
        self.descend(model)
        return float(loss.detach())

    def descend(self, model: Any) -> None:
        for optimizer in model.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

    def parameters(self, model: Any) -> dict[str, torch.Tensor]:
        return dict(model.items())

    def bands(self, model: Any) -> int:
        return math.isqrt(1 + model["shN"].shape[1]) - 1

    def use_bands(self, model: Any, count: int) -> None:
        """Every call says how many it draws; ours draw all."""

    def actions(self) -> dict[str, Action]:
        operations = ("duplicate", "split", "remove", "relocate", "sample_add")
        return {
            **{name: _operation(name) for name in operations},
            "default strategy": default_strategy,
            "mcmc strategy": mcmc_strategy,
            "reset opacity": reset_opacity,
            "noise": noise,
        }

    def mark(self, model: Any, numbers: torch.Tensor) -> None:
        with torch.no_grad():
            model["sh0"][:, 0, 0] = numbers

    def marks(self, model: Any) -> torch.Tensor:
        marks: torch.Tensor = model["sh0"].detach()[:, 0, 0].round().long()
        return marks

    def hide(self, model: Any, row: int) -> None:
        with torch.no_grad():
            model["opacities"][row] = -30.0

    def save(self, model: Any, path: Any) -> None:
        """As PLY; releases that export none are saved as every loop can."""
        if not axes():
            torch.save(model.state_dict(), path)
            return
        tensors = {name: model[name].detach().clone() for name in KEYS}
        import_module("gsplat.exporter").export_splats(**tensors, format="ply", save_to=str(path))

    def load(self, model: Any, path: Any) -> None:
        """gsplat reads no files: users do, and take thresholds up through the session."""
        if axes():
            ply = read_ply(path)
            saved = {key: getattr(ply, name) for key, name in NAMES.items()}
        else:
            saved = torch.load(path)
        for key in KEYS:
            model[key] = torch.nn.Parameter(saved[key].reshape(-1, *model[key].shape[1:]))
        active_session().load(model, path)


def _operation(name: str) -> Action:
    """One of the functions that strategies are made of, on rows drawn by chance."""

    def operate(model: Any, arguments: Any, chance: Chance) -> None:
        count = len(model["means"])
        mask = chance.rows(count)
        options: dict[str, Any] = {"mask": mask}
        if name in ("relocate", "sample_add"):
            options["binoms"] = import_module("gsplat").MCMCStrategy().initialize_state()["binoms"]
        if name == "sample_add":
            options["n"] = 1 + int(10 * options.pop("mask").float().mean())
        if name == "relocate" and not 0 < mask.sum() < count:  # strategies do not ask for it then
            return
        operation = getattr(import_module("gsplat.strategy.ops"), name)
        operation(params=model, optimizers=model.optimizers, state={}, **options)

    return operate


def default_strategy(model: Any, arguments: Any, chance: Chance) -> None:
    """Duplicate, split and prune, as a loop has it after the loss went backward."""
    count = len(model["means"])
    _fade(model, chance)
    options = {"refine_start_iter": 0, "refine_every": 1, "grow_grad2d": 1 - chance.share}
    largest = 1e6 if chance.heads else 0.15
    strategy = import_module("gsplat").DefaultStrategy(grow_scale3d=largest, **options)
    shown = torch.zeros(1, count, 2, requires_grad=True)
    shown.grad = chance.uniform(1, count, 2) / 2
    radii = torch.ones(1, count, *axes(), dtype=torch.int32)
    info = {
        **{"width": 2, "height": 2, "n_cameras": 1, "gaussian_ids": None},
        **{"means2d": shown, "radii": radii},
    }
    state = strategy.initialize_state()
    strategy.step_pre_backward(model, model.optimizers, state, 1, info)
    strategy.step_post_backward(model, model.optimizers, state, 1, info)


def mcmc_strategy(model: Any, arguments: Any, chance: Chance) -> None:
    """Relocate the faint, add some, and shake."""
    _fade(model, chance)
    cap = len(model["means"]) + int(10 * chance.share)
    options = {"refine_start_iter": 0, "refine_every": 1, "cap_max": cap}
    strategy = import_module("gsplat").MCMCStrategy(**options)
    state = strategy.initialize_state()
    strategy.step_post_backward(model, model.optimizers, state, 1, {}, lr=1e-3)


def _fade(model: Any, chance: Chance) -> None:
    """Some rows, not the first, become so faint that they are not worth keeping."""
    faint = chance.rows(len(model["means"]), chance.share / 2)
    faint[0] = False
    with torch.no_grad():
        model["opacities"][faint] = FAINT


def reset_opacity(model: Any, arguments: Any, chance: Chance) -> None:
    """As ``DefaultStrategy`` does now and then."""
    operations = import_module("gsplat.strategy.ops")
    operations.reset_opa(model, model.optimizers, {}, value=0.01)


def noise(model: Any, arguments: Any, chance: Chance) -> None:
    """As ``MCMCStrategy`` does in every step."""
    operations = import_module("gsplat.strategy.ops")
    operations.inject_noise_to_position(model, model.optimizers, {}, scaler=1.0)
