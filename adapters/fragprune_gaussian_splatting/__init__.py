"""yindaheng98/gaussian-splatting: the pip package, and ``gaussian-splatting-mcmc`` that extends it.

The host is an installed package, run as ``python -m gaussian_splatting.train``. Trainers and
densifiers, which wrap one another, change rows. A densifier gives its trainer one instruction: rows
to replace, then to remove, then to add. There are no checkpoints. A run begins from a PLY and
counts its steps from 0 again.
"""

from __future__ import annotations

import ast
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from fragprune_graphdeco import (
    GraphdecoAdapter,
    GraphdecoDialect,
    RasterizerCall,
    every,
    rasterizer_seam,
)
from fragprune_plugins.adapting import (
    CommandLine,
    EngineError,
    Finding,
    HostAdapter,
    HostCall,
    HostInfo,
    HostRepo,
    NotComparedError,
    Photographs,
    Role,
    Seam,
    SeamCall,
    SessionError,
)

PACKAGE, MCMC, REDUCED = "gaussian_splatting", "gaussian_splatting_mcmc", "reduced_3dgs"
MODEL, TRAINER = f"{PACKAGE}.gaussian_model", f"{PACKAGE}.trainer"
DENSIFY = f"{TRAINER}.densifier.trainer", "DensificationTrainer.densify_and_prune"
RASTERIZER = f"{PACKAGE}.diff_gaussian_rasterization"
RELOCATION = f"{MCMC}.trainer.diff_gaussian_rasterization"
REDUCING = ("diff_gaussian_rasterization", "importance.diff_gaussian_rasterization", "simple_knn")
PRUNING = tuple(f"{REDUCED}.{name}._C" for name in REDUCING)
"""What MCMC's training script imports for modes that we do not know."""


class PackageDialect(GraphdecoDialect):
    """Vanilla's call of August 2024, under dotted names."""

    own_kernels = "compiler"

    def names(self) -> frozenset[str]:
        """The import names in ``modules``."""
        knn = (f"{PACKAGE}.simple_knn", f"{PACKAGE}.simple_knn._C")
        return frozenset((RASTERIZER, *knn, RELOCATION, *PRUNING))

    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """Stand-ins for the rasterizer, the neighbour distances and the relocation."""
        from fragprune_graphdeco import stand_ins

        compute = stand_ins.compute_relocation
        relocation = stand_ins.module(RELOCATION, compute_relocation=compute)
        modules = super().modules(draw)
        rasterizer = modules.pop(self.package)
        nested = {f"{PACKAGE}.{name}": module for name, module in modules.items()}
        pruning = {name: _Unanswered(name) for name in PRUNING}
        return {RASTERIZER: rasterizer, **nested, RELOCATION: relocation, **pruning}


class _Unanswered(ModuleType):
    """A module that can be imported; every call of its functions is refused by name."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)

        def refuse(*args: Any, **kwargs: Any) -> None:
            where, found = f"{self.__name__}.{name}", "called without its compiled module"
            remedy = "Choose base or noreg, or run where the package's CUDA modules do."
            raise EngineError(where, found, "a --mode without pruning or culling", remedy)

        return refuse


def optimizers(call: SeamCall) -> list[Any]:
    """The trainer's optimizer; trained cameras are further groups of it."""
    return [call.instance.optimizer]


def step_alone(call: SeamCall) -> Any:
    """Make the step without the opacity reset that is inside it."""
    return call.instance.base_trainer.optim_step()


class GaussianSplatting(GraphdecoAdapter):
    """The pip package gaussian-splatting, with gaussian-splatting-mcmc."""

    name = "gaussian-splatting"
    info = HostInfo(
        "gaussian-splatting (pip)",
        repo="yindaheng98/gaussian-splatting",
        states="2.11 (inria backend), gaussian-splatting-mcmc 1.3",
        limits=(
            "--backend gsplat and gsplat-2dgs are refused; so are, on a CPU, the MCMC extension's "
            "modes pruning and shculling.",
        ),
    )
    installed = (PACKAGE, MCMC, REDUCED)
    package = RASTERIZER
    calls = (RasterizerCall(frozenset({"antialiasing"}), 3),)
    drawn_from = ("colors_precomp",)  # nobody gives it
    scripts = (f"{PACKAGE}/train.py",)
    dialect_type = PackageDialect
    seams = (
        Seam(Role.ATTACH, f"{TRAINER}.base", "BaseTrainer.__init__", ("model",), how=optimizers),
        Seam(Role.STEP, f"{TRAINER}.abc", "AbstractTrainer.update_learning_rate"),
        Seam(Role.VIEW, MODEL, "GaussianModel.render", ("viewpoint_camera",)),
        rasterizer_seam(RASTERIZER),
        Seam(Role.LOSS, "torch", "Tensor.backward", external=True),
        Seam(Role.METRIC, f"{PACKAGE}.utils.lpipsPyTorch", "lpips"),
        Seam(Role.REARRANGE, *DENSIFY, ("loss", "out", "camera")),
        Seam(Role.STILL, f"{TRAINER}.opacity_reset", "OpacityResetter.optim_step", how=step_alone),
        Seam(Role.STILL, f"{TRAINER}.sh_lift", "SHLifter.oneupSHdegree"),
        Seam(Role.SAVE, MODEL, "GaussianModel.save_ply", ("path",)),
        Seam(Role.LOAD, MODEL, "GaussianModel.load_ply", ("path",)),
    )
    noise = Seam(Role.STILL, f"{MCMC}.trainer.noise", "Noiser.add_noise", ("gaussians", "xyz_lr"))

    def seams_for(self, repo: HostRepo) -> tuple[Seam, ...]:
        """The seams, with one for MCMC's noise if MCMC is installed."""
        return (*self.seams, self.noise) if repo.path(f"{MCMC}.trainer") else self.seams

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """Check that this is the installed package, not a checkout of the same name; nor one of
        which scripts import what the installed one lacks.
        """
        package, installed = HostAdapter.fingerprint(self, repo), HostRepo.installed(PACKAGE)
        if repo.package:
            return [*package, *super().fingerprint(repo)]
        scripts = (repo.tree(each.stem) for each in sorted(repo.root.glob("*.py")))
        taken = (each.module or "" for tree in scripts for each in every(tree, ast.ImportFrom))
        for name in (each for each in taken if each.startswith(f"{PACKAGE}.")):
            if installed and installed.path(name) is None:
                return [Finding.error("own-host", repo.root, f"imports {name}", PACKAGE), *package]
        return package

    def command_line(self, repo: HostRepo) -> CommandLine:
        """The flags of ``gaussian_splatting.train``, which MCMC's script shares."""
        return CommandLine(
            scripts=(f"{PACKAGE}/train.py", f"{MCMC}/train.py"),
            iterations=("-i", "--iteration"),
            output=("-d", "--destination"),
            source=("-s", "--source"),
            save_checkpoints="--save_iterations",
            resume=("-l", "--load_ply"),
            default_iterations=30_000,
            restarts=True,
            in_full=super().command_line(repo).in_full,
        )

    def photographs(self, repo: HostRepo, arguments: list[str]) -> Photographs:
        """All photographs, as they are: it trains on every view."""
        folder = Path(self.command_line(repo).read(arguments).source or "")
        masks = folder / "image_masks"
        found = "cameras that it trains" if _cameras(arguments)[0] else ""
        if "--no_image_mask" not in arguments and masks.is_dir():
            found = f"photographs under the masks in {masks}"
        if found:
            expected = "photographs and cameras of a COLMAP scene, as they are"
            remedy = "Leave some views out of the COLMAP model; fragprune compare measures those."
            raise NotComparedError("gaussian-splatting (pip)", found, expected, remedy)
        return Photographs(folder, centred=True, opaque=True, held_out=False)

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """The command for stage 2; if cameras were trained, it takes those of stage 1."""
        own, written = _cameras(arguments)
        more = ["--load_camera", str(written)] if own and written else []
        return script, [*arguments, *more]

    def model_of(self, call: SeamCall) -> Any:
        """The model of a trainer, or the argument from which a trainer is being made."""
        model = call.arguments.get("model", call.arguments.get("gaussians"))
        model = getattr(call.instance, "model", call.instance) if model is None else model
        if type(model).__module__.startswith(f"{PACKAGE}.models"):
            name, found = type(model).__name__, "a model of --backend gsplat"
            raise SessionError(name, found, "inria", "Change it.")
        return model

    def view(self, camera: Any) -> int:
        """A key of the camera: its matrix. Cameras are tuples, which hosts copy."""
        return id(camera.world_view_transform)


def _cameras(arguments: list[str]) -> tuple[bool, Path | None]:
    """Whether cameras are not the scene's own, and where a training writes those it trained."""
    parser = ArgumentParser(add_help=False)
    parser.add_argument("--mode", default="")
    parser.add_argument("--load_camera")
    parser.add_argument("-d", "--destination")
    known, _ = parser.parse_known_args(arguments)
    trained = "camera" in known.mode and not known.load_camera and known.destination
    own = "camera" in known.mode or bool(known.load_camera)
    return own, Path(known.destination) / "cameras.json" if trained else None
