"""The demo's host in this process: imported, driven step by step, and forgotten again.

It has vanilla 2023's public shape and asks for CUDA everywhere, so ``--device cpu`` is around it.
"""

from __future__ import annotations

import contextlib
import sys
from argparse import ArgumentParser
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from fragprune_plugins import demo
from fragprune_plugins.adapter import HostAdapter
from fragprune_plugins.detect import HostRepo
from fragprune_plugins.device import cpu_only
from fragprune_plugins.plugins import load_plugins
from fragprune_plugins.schedule import Settings
from fragprune_plugins.session import Session
from fragprune_vanilla_3dgs import Vanilla3DGS

HOST = Path(demo.__file__).with_name("host")

TINY = [
    *("-r", "1", "--sh_degree", "1", "--eval"),
    *("--densify_from_iter", "4", "--densification_interval", "5"),
    *(
        "--densify_until_iter",
        "18",
        "--densify_grad_threshold",
        "0.0008",
        "--opacity_reset_interval",
        "3000",
    ),
    *("--test_iterations", "-1"),
]
"""Flags with which a run of a few dozen iterations densifies and prunes."""


@dataclass
class Running:
    """A host under a session, and the handful of things a training loop does with it."""

    session: Session
    arguments: SimpleNamespace

    def __getattr__(self, name: str) -> Any:
        return getattr(self.session, name)

    def model(self, count: int = 30, *, seed: int = 0, degree: int = 1, setup: bool = True) -> Any:
        """A model of random points in front of the camera."""
        generator = np.random.default_rng(seed)
        spread = generator.uniform(-1, 1, (count, 3)) * (0.9, 0.6, 0.5)
        cloud = SimpleNamespace(points=spread, colors=generator.uniform(0, 1, (count, 3)))
        model = import_module("scene.gaussian_model").GaussianModel(degree)
        model.create_from_pcd(cloud, 1.0)
        with torch.no_grad():
            model._opacity += torch.linspace(0.5, 4.0, count)[:, None]
        if setup:
            model.training_setup(self.arguments)
        return model

    def camera(self, width: int = 24, height: int = 18, *, side: float = 0.0) -> Any:
        """A camera three units in front of the points."""
        picture = np.random.default_rng(7).integers(0, 255, (height, width, 3), dtype=np.uint8)
        position = np.array([side, 0.0, 3.0])
        camera = import_module("scene.cameras").Camera
        return camera(0, np.eye(3), position, 0.8, 0.6, picture, "photo", "cuda")

    def render(self, camera: Any, model: Any, background: Any = None) -> dict[str, Any]:
        """The host's own function, as its scripts hold it."""
        pipe = SimpleNamespace(debug=False, compute_cov3D_python=False, convert_SHs_python=False)
        background = torch.zeros(3) if background is None else background
        return import_module("gaussian_renderer").render(camera, model, pipe, background)

    def step(self, model: Any, camera: Any, iteration: int) -> float:
        """One iteration in the hosts' order; returns the loss."""
        model.update_learning_rate(iteration)
        package = self.render(camera, model)
        loss = (package["render"] - camera.original_image).abs().mean()
        loss.backward()
        with torch.no_grad():
            model.add_densification_stats(package["viewspace_points"], package["visibility_filter"])
            model.optimizer.step()
            model.optimizer.zero_grad(set_to_none=True)
        return float(loss.detach())


@contextlib.contextmanager
def imported(path: Path) -> Iterator[None]:
    """A host's folder first on the path; its modules are forgotten afterwards."""
    known = set(sys.modules)
    sys.path.insert(0, str(path))
    try:
        yield
    finally:
        sys.path.remove(str(path))
        for name in sys.modules.keys() - known:
            file = getattr(sys.modules[name], "__file__", None) or ""
            if Path(file).is_relative_to(path):
                del sys.modules[name]


@contextlib.contextmanager
def running(
    settings: Settings | None = None,
    *,
    plugins: Any = None,
    active: bool = True,
    path: Path = HOST,
    adapter: HostAdapter | None = None,
    **options: Any,
) -> Iterator[Running]:
    """The host, imported under a session (activated unless told otherwise)."""
    loaded = load_plugins()
    for index, plugin in enumerate(plugins or ()):
        loaded.manager.register(plugin, f"test-{index}")
    settings = settings or Settings(iterations=20)
    options = {"drop_in": True} | options
    session = Session(adapter or Vanilla3DGS(), HostRepo(path), loaded, settings, **options)
    with imported(path), cpu_only():
        if active:
            session.activate()
        try:
            parser = ArgumentParser()
            group = import_module("arguments").OptimizationParams(parser)
            yield Running(session, group.extract(parser.parse_args([])))
        finally:
            session.deactivate()


def joint(settings: Settings | None = None, **options: Any) -> Any:
    """The host under a session that learns from the first step and freezes nothing."""
    from fragprune_plugins.schedule import JointSchedule

    settings = settings or Settings(iterations=20)
    schedule = JointSchedule(settings, 1)
    return running(settings, freeze=False, schedule=schedule, **options)


def identity(model: Any) -> torch.Tensor:
    """(N,) the number each row carries in its red coefficient, which hosts copy to children."""
    numbers: torch.Tensor = model._features_dc.detach()[:, 0, 0].round().long()
    return numbers


def label(host: Running, model: Any) -> None:
    """Give row i the identity i, and a threshold and moments that only i has."""
    numbers = torch.arange(len(model.get_xyz)).float()
    with torch.no_grad():
        model._features_dc[:, 0, 0] = numbers
    store = host.store(model)
    store.load_state_dict(
        {
            "logits": -3 + numbers / 8,
            "exp_avg": numbers + 1,
            "exp_avg_sq": numbers + 1,
            "adam_step": 2.0,
            "steps": 2,
        }
    )


def expect_ancestors(host: Running, model: Any) -> None:
    """Every row has the threshold of the row it descends from, and its moments or none."""
    store, state = host.store(model), host.store(model).state_dict()
    assert len(store) == len(model.get_xyz) == len(identity(model))
    expected = -3 + identity(model).float() / 8
    assert torch.equal(state["logits"], expected)
    moments = state["exp_avg"]
    old = moments != 0  # children start without moments, as the hosts' do
    assert torch.equal(moments[old], identity(model).float()[old] + 1)
    assert torch.equal(state["exp_avg_sq"], moments)


def tensors(model: Any) -> dict[str, torch.Tensor]:
    """Copies of the model's parameters by the names of its optimizer groups."""
    return {
        group["name"]: group["params"][0].detach().clone() for group in model.optimizer.param_groups
    }
