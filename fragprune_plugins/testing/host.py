"""How the conformance kit drives a host, alone and under a session.

The kit knows no training script. It makes a model and a camera, draws, takes a step, and calls the
methods that add, remove and overwrite rows. A ``Host`` says how. Its defaults fit the codebases
that descend from 3DGS of 2023, so a descendant overrides only its differences.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import math
import shutil
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fragprune_plugins.constants import NEUTRAL_LOGIT
from fragprune_plugins.hosts.adapter import HostAdapter
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.cpu_only import cpu_only
from fragprune_plugins.injection.process import forget_modules
from fragprune_plugins.injection.session import Session
from fragprune_plugins.learning.schedule import JointSchedule, Settings
from fragprune_plugins.plugins.loading import GROUP, load_plugins
from fragprune_plugins.types import View
from fragprune_plugins.workbench import demo

MINIATURE = Path(demo.__file__).with_name("host")
"""The demo's training repository: vanilla 3DGS of 2023 by its interface, small."""

FAINT = -9.0  # logit of opacities that an action makes too faint to keep


@dataclass
class Chance:
    """The randomness of one action; an equal ``Chance`` repeats the action.

    Attributes:
        seed: of all random numbers.
        share: the approximate share of rows to choose, in (0, 1).
    """

    seed: int
    share: float

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(self.seed)

    def uniform(self, *shape: int) -> Tensor:
        """Random numbers in [0, 1), of this shape."""
        return torch.rand(*shape, generator=self.generator)

    def rows(self, count: int, share: float | None = None) -> Tensor:
        """(count,) bool: each row is True with probability ``share``, by default this chance's."""
        return self.uniform(count) < (self.share if share is None else share)

    @property
    def heads(self) -> bool:
        """True or False with equal probability."""
        return bool(self.seed % 2)


Action = Callable[[Any, Any, Chance], None]
"""Called with a model, the training arguments and a chance; changes the model's rows."""


class Host:
    """How to drive one host; override the differences from vanilla 3DGS of 2023.

    ``write`` makes a miniature, so tests need no checkout. All else must work on a checkout too.
    """

    package: str = ""
    """Import name of the installed package that is the host; no miniature is written then."""
    variant: str = ""
    """What tells this way of driving a host from others, in the report."""
    lacks: Mapping[str, str] = MappingProxyType({})
    """Promises that cannot be asked of the host, by name ("checkpoint"), and why not."""
    renderer: str = "gaussian_renderer:render"
    """The host's function that draws a view, "module:function"."""
    draws_alone: bool = True
    """Without a session the host can draw here, through our stand-ins for compiled packages."""
    opacity: frozenset[str] = frozenset({"opacity"})
    """Parameters that ``--train opacity`` moves; all others stand still."""
    colour: frozenset[str] = frozenset({"f_dc", "f_rest"})
    """Those that ``--train appearance`` moves besides."""
    routine: tuple[str, ...] = ("densify and prune", "reset opacity", "another band")
    """Actions of the host's own training loop; none may have an effect in stage 2."""
    scale: float = 3.0
    """Extent of the scene in the host's densification, world units."""

    def write(self, root: Path) -> None:
        """Write a miniature of the host into an empty folder."""
        shutil.copytree(MINIATURE, root, dirs_exist_ok=True)

    # -- making things ---------------------------------------------------------------------------

    def arguments(self) -> Any:
        """The argument of ``training_setup``: the host's own defaults."""
        parser = ArgumentParser()
        group = import_module("arguments").OptimizationParams(parser)
        return group.extract(parser.parse_args([]))

    def new_model(self, degree: int) -> Any:
        """An empty model with SH bands up to ``degree``."""
        return import_module("scene.gaussian_model").GaussianModel(degree)

    def fill(self, model: Any, cloud: Any) -> None:
        """Fill from a cloud: ``points``, ``colors``, ``normals`` (N, 3) and ``time`` (N, 1)."""
        given = {"pcd": cloud, "cam_infos": [SimpleNamespace(image_name="photo")]}
        names = inspect.signature(model.create_from_pcd).parameters
        model.create_from_pcd(**{name: given.get(name, 1.0) for name in names})

    def model(self, arguments: Any, count: int, *, seed: int, degree: int, setup: bool) -> Any:
        """A model of random points in front of the camera, opacities from a half to 0.98."""
        generator = np.random.default_rng(seed)
        spread = generator.uniform(-1, 1, (count, 3)) * (0.9, 0.6, 0.5)
        cloud = SimpleNamespace(
            points=spread,
            colors=generator.uniform(0, 1, (count, 3)),
            normals=np.zeros((count, 3)),
            time=generator.uniform(-0.4, 0.4, (count, 1)),
        )
        model = self.new_model(degree)
        self.fill(model, cloud)
        with torch.no_grad():
            model._opacity += torch.linspace(0.5, 4.0, count)[:, None]
        if setup:
            model.training_setup(arguments)
        return model

    def camera(self, width: int, height: int, *, side: float = 0.0) -> Any:
        """A camera three units in front of the points, with a photograph."""
        pixels = np.random.default_rng(7).integers(0, 255, (3, height, width), dtype=np.uint8)
        fov_x, fov_y = 0.8, 0.6
        view = View.pinhole(
            torch.eye(3),
            torch.tensor([side, 0.0, 3.0]),
            width=width,
            height=height,
            fx=width / (2 * math.tan(fov_x / 2)),
            fy=height / (2 * math.tan(fov_y / 2)),
        )
        return SimpleNamespace(
            uid=int(10 * side),
            image_name="photo",
            image_width=width,
            image_height=height,
            FoVx=fov_x,
            FoVy=fov_y,
            world_view_transform=view.viewmatrix,
            full_proj_transform=view.projmatrix,
            camera_center=view.campos,
            original_image=torch.from_numpy(pixels).float() / 255,
        )

    # -- drawing and learning --------------------------------------------------------------------

    def pipe(self) -> Any:
        """The pipeline options that hosts pass to ``render``."""
        return SimpleNamespace(
            debug=False, compute_cov3D_python=False, convert_SHs_python=False, antialiasing=False
        )

    def render(self, camera: Any, model: Any, background: Tensor) -> dict[str, Any]:
        """Call the host's render function; returns a dict with "render" (3, H, W)."""
        module, function = self.renderer.split(":")
        draw = getattr(import_module(module), function)
        package: dict[str, Any] = draw(camera, model, self.pipe(), background)
        return package

    def step(self, model: Any, camera: Any, iteration: int, background: Tensor) -> float:
        """One iteration in the host's order, densification left out; returns the loss."""
        model.update_learning_rate(iteration)
        package = self.render(camera, model, background)
        loss = (package["render"] - camera.original_image).abs().mean()
        loss.backward()
        with torch.no_grad():
            self.gather(model, package)
            self.descend(model)
        return float(loss.detach())

    def gather(self, model: Any, package: dict[str, Any]) -> None:
        """Accumulate the statistics by which the host densifies."""
        model.add_densification_stats(package["viewspace_points"], package["visibility_filter"])

    def descend(self, model: Any) -> None:
        """Step the optimizers."""
        model.optimizer.step()
        model.optimizer.zero_grad(set_to_none=True)

    def parameters(self, model: Any) -> dict[str, Tensor]:
        """Every trained tensor by the name of its param group."""
        return {group["name"]: group["params"][0] for group in model.optimizer.param_groups}

    def bands(self, model: Any) -> int:
        """How many SH bands above the constant one are drawn."""
        return int(model.active_sh_degree)

    def use_bands(self, model: Any, count: int) -> None:
        """Draw with this many of the model's SH bands."""
        model.active_sh_degree = min(count, model.max_sh_degree)

    # -- rows ------------------------------------------------------------------------------------

    def actions(self) -> Mapping[str, Action]:
        """All actions that change rows, by name; tests try sequences of them."""
        return {
            "prune": prune,
            "clone": clone,
            "split": split,
            "densify and prune": densify_and_prune,
            "reset opacity": reset_opacity,
            "another band": lambda model, arguments, chance: model.oneupSHdegree(),
            "restore": self.restore_from_file,
            "training setup": lambda model, arguments, chance: model.training_setup(arguments),
        }

    def restore_from_file(self, model: Any, arguments: Any, chance: Chance) -> None:
        """Write a checkpoint, and restore it into the same model."""
        file = io.BytesIO()
        torch.save((self.capture(model), 7), file)
        file.seek(0)
        self.restore(model, torch.load(file, weights_only=False)[0], arguments)

    def mark(self, model: Any, numbers: Tensor) -> None:
        """Write numbers (N,) into the rows, where the host copies them from parents to children."""
        with torch.no_grad():
            model._features_dc[:, 0, 0] = numbers

    def marks(self, model: Any) -> Tensor:
        """(N,) int64: the rows' numbers; -1 for rows without a parent."""
        numbers: Tensor = model._features_dc.detach()[:, 0, 0].round().long()
        return numbers

    def hide(self, model: Any, row: int) -> None:
        """Make one Gaussian so faint that it is never drawn."""
        with torch.no_grad():
            self.parameters(model)["opacity"][row] = -30.0

    # -- files -----------------------------------------------------------------------------------

    def save(self, model: Any, path: Path) -> None:
        """Save a model with the host's own method."""
        model.save_ply(str(path))

    def load(self, model: Any, path: Path) -> None:
        """Load a saved model into an empty one with the host's own method."""
        model.load_ply(str(path))

    def capture(self, model: Any) -> Any:
        """The host's checkpoint of a model."""
        return model.capture()

    def restore(self, model: Any, captured: Any, arguments: Any) -> None:
        """Restore a model from the host's checkpoint."""
        model.restore(captured, arguments)


def reset_opacity(model: Any, arguments: Any, chance: Chance) -> None:
    """Reset opacities, once the optimizer has stepped; before that, hosts fail."""
    if model.optimizer.state:
        model.reset_opacity()


def prune(model: Any, arguments: Any, chance: Chance) -> None:
    """Remove rows by a mask, torch's or, for some hosts, NumPy's."""
    gone = chance.rows(len(model.get_xyz))
    _with_radii(model)
    model.prune_points(gone.numpy() if chance.heads else gone)


def clone(model: Any, arguments: Any, chance: Chance) -> None:
    """Copy small rows with large gradients."""
    _densify(model.densify_and_clone, model, 1e6, chance)


def split(model: Any, arguments: Any, chance: Chance) -> None:
    """Divide large rows with large gradients."""
    _densify(model.densify_and_split, model, 1e-6, chance)


def _densify(method: Any, model: Any, all_rows: float, chance: Chance) -> None:
    grads = chance.uniform(len(model.get_xyz), 1)
    _with_radii(model)
    method(grads, 1 - chance.share, all_rows if chance.seed % 3 else 3.0)


def densify_and_prune(model: Any, arguments: Any, chance: Chance, *more: Any) -> None:
    """Call the host's ``densify_and_prune``: clone, split, prune faint and large Gaussians."""
    n = len(model.get_xyz)
    model.xyz_gradient_accum = chance.uniform(n, 1)
    model.denom = chance.rows(n, 0.8)[:, None].float()
    with torch.no_grad():
        model._opacity[chance.rows(n, chance.share / 2)] = FAINT
    model.max_radii2D = 40 * chance.uniform(n)
    largest = 20 if chance.heads else None
    radii = [torch.ones(n)] if _takes_radii(model.densify_and_prune) else []
    model.densify_and_prune(1 - chance.share, 0.005, 3.0, largest, *radii, *more)


def _takes_radii(method: Any) -> bool:
    return method is not None and "radii" in inspect.signature(method).parameters


def _with_radii(model: Any) -> None:
    """Keep radii on the model meanwhile, as revisions do whose ``densify_and_prune`` takes them."""
    if _takes_radii(getattr(model, "densify_and_prune", None)):
        model.tmp_radii = torch.ones(len(model.get_xyz))


@dataclass
class Running:
    """A host under a session, with the actions of a training loop."""

    session: Session
    driver: Host
    arguments: Any

    def __getattr__(self, name: str) -> Any:
        return getattr(self.session, name)

    def model(self, count: int = 30, *, seed: int = 0, degree: int = 1, setup: bool = True) -> Any:
        """A model of random points in front of the camera."""
        return self.driver.model(self.arguments, count, seed=seed, degree=degree, setup=setup)

    def camera(self, width: int = 24, height: int = 18, *, side: float = 0.0) -> Any:
        """A camera three units in front of the points."""
        return self.driver.camera(width, height, side=side)

    def render(self, camera: Any, model: Any, background: Tensor | None = None) -> dict[str, Any]:
        """Draw a view with the host's own function."""
        background = torch.zeros(3) if background is None else background
        return self.driver.render(camera, model, background)

    def gradients(self, model: Any) -> dict[str, Tensor]:
        """Of the trained tensors that have one, by the name of their param group."""
        parameters = self.driver.parameters(model).items()
        return {name: each.grad for name, each in parameters if each.grad is not None}

    def step(self, model: Any, camera: Any, iteration: int) -> float:
        """One iteration in the hosts' order; returns the loss."""
        return self.driver.step(model, camera, iteration, torch.zeros(3))


@contextlib.contextmanager
def imported(path: Path, packages: tuple[str, ...] = ()) -> Iterator[None]:
    """Put a host's folder, or that of its ``packages``, on the path; then forget its modules."""
    known = set(sys.modules)
    sys.path.insert(0, str(path))
    try:
        yield
    finally:
        sys.path.remove(str(path))
        forget_modules(path, known, packages)


@cache
def _entries() -> tuple[EntryPoint, ...]:
    """Of installed plugins: to look them up takes as long as to load them."""
    return tuple(entry_points(group=GROUP))


@contextlib.contextmanager
def running(
    settings: Settings | None = None,
    *,
    adapter: HostAdapter,
    path: Path = MINIATURE,
    driver: Host | None = None,
    plugins: Any = None,
    active: bool = True,
    **options: Any,
) -> Iterator[Running]:
    """Import the host in this process under a session, by default active and with our stand-ins.

    Args:
        active: False leaves the session's activation to the caller.
        options: of the session.
    """
    loaded = load_plugins(_entries())
    for index, plugin in enumerate(plugins or ()):
        loaded.register(plugin, f"test-{index}")
    settings, driver = settings or Settings(iterations=20, stop=None), driver or Host()
    repo = HostRepo(path, driver.package)
    session = Session(adapter, repo, loaded, settings, **({"drop_in": True} | options))
    with imported(path, packages_of(adapter, driver)), cpu_only():
        if active:
            session.activate()
        try:
            yield Running(session, driver, driver.arguments())
        finally:
            session.deactivate()


def packages_of(adapter: HostAdapter, driver: Host) -> tuple[str, ...]:
    """The installed packages of the host; empty if it is a checkout."""
    return adapter.installed if driver.package else ()


@contextlib.contextmanager
def alone(*, driver: Host, **options: Any) -> Iterator[Running]:
    """The host alone, with nothing wrapped; our stand-ins replace its compiled packages.

    If the host cannot draw so on this machine, a session draws for it and follows no model.
    """
    with running(driver=driver, active=not driver.draws_alone, learn=False, **options) as host:
        if driver.draws_alone:
            host.session.stand_ins.place()
        yield host


def joint(settings: Settings | None = None, **options: Any) -> Any:
    """The host under a session that learns from the first step and freezes nothing."""
    settings = settings or Settings(iterations=20, stop=None)
    return running(settings, freeze=False, schedule=JointSchedule(settings, 1), **options)


def tensors(driver: Host, model: Any) -> dict[str, Tensor]:
    """Copies of the model's parameters by the names of its param groups."""
    return {name: value.detach().clone() for name, value in driver.parameters(model).items()}


def logits_of(marks: Tensor) -> Tensor:
    """The threshold logit that ``label`` gives to a marked row."""
    return -3 + marks.float() / 8


def label(host: Running, model: Any) -> None:
    """Mark row i with i, and give it a unique threshold and unique moments."""
    numbers = torch.arange(len(host.adapter.means(model)))
    host.driver.mark(model, numbers)
    moments = dict.fromkeys(("exp_avg", "exp_avg_sq"), numbers.float() + 1)
    state = {"logits": logits_of(numbers), **moments, "adam_step": 2.0, "steps": 2}
    host.store(model).load_state_dict(state)


def expect_ancestors(host: Running, model: Any) -> None:
    """Raise AssertionError unless each row has its ancestor's threshold, and its moments or none.

    The host itself copies the marks from parents to children, so they tell each row's ancestor. At
    most one descendant of a row may have its moments.
    """
    store, marks = host.store(model), host.driver.marks(model)
    rows, state = len(host.adapter.means(model)), store.state_dict()
    if not len(store) == rows == len(marks):
        raise AssertionError(f"{len(store)} thresholds for {rows} Gaussians")
    neutral = torch.full((rows,), NEUTRAL_LOGIT)
    expected = torch.where(marks >= 0, logits_of(marks), neutral)
    moments = state["exp_avg"]
    own = torch.where(marks >= 0, marks.float() + 1, 0.0)
    right = (state["logits"] == expected) & ((moments == 0) | (moments == own))
    right &= state["exp_avg_sq"] == moments  # children start without, as the hosts' do
    if not right.all():
        row = int((~right).nonzero()[0])
        said = f"row {row} of {rows} descends from {marks[row]} and must have the logit "
        said += f"{expected[row]:g} and moments {own[row]:g} or 0; it has "
        raise AssertionError(f"{said}{state['logits'][row]:g} and {moments[row]:g}")
    held = moments[moments != 0]
    if len(held.unique()) != len(held):
        raise AssertionError(f"two rows have the moments of one: {sorted(held.tolist())}")
