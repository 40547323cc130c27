"""yindaheng98/gaussian-splatting: the pip package, and ``gaussian-splatting-mcmc`` that extends it.

No checkout: an installed package, run as ``python -m gaussian_splatting.train``. Its methods on
rows belong to trainers and densifiers, which wrap one another. A densifier hands its trainer one
instruction: rows to replace, then to remove, then to add. There are no checkpoints; a run begins
from a PLY and counts its steps from 0 again.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any, NoReturn

from fragprune_plugins.adapting import (
    AlignmentError,
    CommandLine,
    EngineError,
    Finding,
    GraphdecoAdapter,
    GraphdecoDialect,
    HostAdapter,
    HostCall,
    HostInfo,
    HostRepo,
    NotComparedError,
    RasterizerCall,
    Role,
    RowTrace,
    Seam,
    SeamCall,
    SessionError,
    hookimpl,
)

if TYPE_CHECKING:
    from torch import Tensor

PACKAGE, MCMC, REDUCED = "gaussian_splatting", "gaussian_splatting_mcmc", "reduced_3dgs"
MODEL, TRAINER = f"{PACKAGE}.gaussian_model", f"{PACKAGE}.trainer"
RASTERIZER = f"{PACKAGE}.diff_gaussian_rasterization"
RELOCATION = f"{MCMC}.trainer.diff_gaussian_rasterization"
PRUNING = tuple(
    f"{REDUCED}.{name}._C"
    for name in (
        *("diff_gaussian_rasterization", "importance.diff_gaussian_rasterization"),
        "simple_knn",
    )
)
"""What MCMC's training script imports for modes that we do not know."""
SETTINGS = (
    *("image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix"),
    *("projmatrix", "sh_degree", "campos", "prefiltered", "debug", "antialiasing"),
)


class PackageDialect(GraphdecoDialect):
    """Vanilla's call of August 2024, under dotted names."""

    def names(self) -> frozenset[str]:
        """As ``modules`` has them."""
        knn = (f"{PACKAGE}.simple_knn", f"{PACKAGE}.simple_knn._C")
        return frozenset((RASTERIZER, *knn, RELOCATION, *PRUNING))

    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """The rasterizer, the neighbour distances and the relocation, inside their packages."""
        from fragprune_plugins.adapting import stand_ins

        relocation = ModuleType(RELOCATION, "Stand-in of fragprune.")
        vars(relocation)["compute_relocation"] = stand_ins.compute_relocation
        modules = super().modules(draw)
        rasterizer = modules.pop(self.package)
        nested = {f"{PACKAGE}.{name}": module for name, module in modules.items()}
        pruning = {name: _Unanswered(name) for name in PRUNING}
        return {RASTERIZER: rasterizer, **nested, RELOCATION: relocation, **pruning}


class _Unanswered(ModuleType):
    """Imports, and refuses by name what is called."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)

        def refuse(*args: Any, **kwargs: Any) -> None:
            raise EngineError(
                f"{self.__name__}.{name}",
                "called without its compiled module",
                "a --mode without pruning or culling",
                "Choose base or noreg, or run where the package's CUDA modules do.",
            )

        return refuse


def optimizers(call: SeamCall) -> list[Any]:
    """One, the trainer's; cameras that are trained join it as further groups."""
    return [call.instance.optimizer]


def step_alone(call: SeamCall) -> Any:
    """The opacity reset sits inside a step: the step itself is still to be made."""
    return call.instance.base_trainer.optim_step()


@contextmanager
def tracing(call: SeamCall) -> Iterator[RowTrace]:
    """Row numbers ride along as one more coefficient of the colour, which densifiers only copy.

    The bits of an integer, not its value: every row number is exact.
    """
    import torch

    trainer, model, trace = call.instance, call.model, RowTrace()
    densifier, colour = trainer.densifier, model._features_dc
    numbers = torch.arange(len(colour), dtype=torch.int32, device=colour.device)
    rider = numbers.view(torch.float32)[:, None, None].expand(-1, 1, colour.shape[2])

    def noting(*args: Any, **kwargs: Any) -> Any:
        model._features_dc = torch.nn.Parameter(torch.cat([colour.detach(), rider], dim=1))
        try:
            instruct = densifier.densify_and_prune(*args, **kwargs)
        finally:
            model._features_dc = colour
        if any(each is not None for each in vars(instruct).values()):
            trace.origins, trace.fresh = _follow(instruct, numbers)
        return instruct._replace(
            new_features_dc=_without_rider(instruct.new_features_dc),
            replace_features_dc=_without_rider(instruct.replace_features_dc),
        )

    hook = densifier.after_densify_and_prune_hook
    trainer.densifier = SimpleNamespace(densify_and_prune=noting, after_densify_and_prune_hook=hook)
    try:
        yield trace
    finally:
        trainer.densifier = densifier


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
    renderer = MODEL
    calls = (RasterizerCall(frozenset({"antialiasing"}), 3, "GaussianModel.render"),)
    scripts = (f"{PACKAGE}/train.py",)
    dialect_type = PackageDialect
    seams = (
        Seam(Role.ATTACH, f"{TRAINER}.base", "BaseTrainer.__init__", ("model",), how=optimizers),
        Seam(Role.STEP, f"{TRAINER}.abc", "AbstractTrainer.update_learning_rate"),
        Seam(Role.VIEW, MODEL, "GaussianModel.render", ("viewpoint_camera",)),
        Seam(
            Role.RASTERIZE,
            RASTERIZER,
            "GaussianRasterizer.forward",
            ("means3D", "means2D", "opacities"),
            external=True,
        ),
        Seam(Role.LOSS, "torch", "Tensor.backward", external=True),
        Seam(Role.METRIC, f"{PACKAGE}.utils.lpipsPyTorch", "lpips"),
        Seam(
            Role.REARRANGE,
            f"{TRAINER}.densifier.trainer",
            "DensificationTrainer.densify_and_prune",
            ("loss", "out", "camera"),
            how=tracing,
        ),
        Seam(Role.STILL, f"{TRAINER}.opacity_reset", "OpacityResetter.optim_step", how=step_alone),
        Seam(Role.STILL, f"{TRAINER}.sh_lift", "SHLifter.oneupSHdegree"),
        Seam(Role.SAVE, MODEL, "GaussianModel.save_ply", ("path",)),
        Seam(Role.LOAD, MODEL, "GaussianModel.load_ply", ("path",)),
    )
    noise = Seam(Role.STILL, f"{MCMC}.trainer.noise", "Noiser.add_noise", ("gaussians", "xyz_lr"))

    def seams_for(self, repo: HostRepo) -> tuple[Seam, ...]:
        """MCMC's noise where it is installed; its relocation is a densifier like any other."""
        return (*self.seams, self.noise) if repo.path(f"{MCMC}.trainer") else self.seams

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """The package itself, not a checkout of something that bears its name."""
        if repo.package in self.installed:
            revision = Finding("info", "revision", repo.package, repo.commit)
            return [revision, *super().fingerprint(repo)]
        return [
            Finding(
                "error",
                "other-host",
                str(repo.root),
                "a folder",
                f"the installed package {PACKAGE}, as python -m {PACKAGE}.train runs it",
                "Use the adapter of that host.",
            )
        ]

    def dialect(self, repo: HostRepo) -> PackageDialect:
        """One call: what ``GaussianModel.render`` passes and unpacks."""
        return PackageDialect(package=RASTERIZER, settings=SETTINGS, outputs=3)

    def command_line(self, repo: HostRepo) -> CommandLine:
        """The flags of ``gaussian_splatting.train``, which MCMC's has too."""
        return CommandLine(
            scripts=(f"{PACKAGE}/train.py", f"{MCMC}/train.py"),
            iterations=("-i", "--iteration"),
            output=("-d", "--destination"),
            source=("-s", "--source"),
            save_checkpoints="--save_iterations",
            resume=("-l", "--load_ply"),
            default_iterations=30_000,
            restarts=True,
        )

    def photographs(self, repo: HostRepo, arguments: list[str]) -> NoReturn:
        """None that it has not learned from."""
        raise NotComparedError(
            "gaussian-splatting (pip)",
            "a package that trains on every view",
            "views that are held out",
            "Leave some out of the COLMAP model, then fragprune compare on all of them.",
        )

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """Where cameras were trained, stage 2 takes them as stage 1 left them."""
        parser = ArgumentParser(add_help=False)
        parser.add_argument("--mode", default="")
        parser.add_argument("--load_camera")
        parser.add_argument("-d", "--destination")
        known, _ = parser.parse_known_args(arguments)
        trained = "camera" in known.mode and not known.load_camera and known.destination
        cameras = Path(known.destination) / "cameras.json" if trained else None
        return script, [*arguments, *(["--load_camera", str(cameras)] if cameras else [])]

    def model_of(self, call: SeamCall) -> Any:
        """Trainers hold the model, or are about to when they are made."""
        model = call.arguments.get("model", call.arguments.get("gaussians"))
        model = getattr(call.instance, "model", call.instance) if model is None else model
        if type(model).__module__.startswith(f"{PACKAGE}.models"):
            raise SessionError(
                f"{type(model).__name__}", "a model of --backend gsplat", "inria", "Change it."
            )
        return model

    def view(self, camera: Any) -> int:
        """Cameras are tuples, copied to change a background; their matrices stay."""
        return id(camera.world_view_transform)


def _without_rider(colour: Tensor | None) -> Tensor | None:
    return None if colour is None else colour[:, :1].contiguous()


def _follow(instruct: Any, numbers: Tensor) -> tuple[Tensor, Tensor]:
    """Origins of the rows an instruction leaves, and which of them are new or made over.

    Args:
        instruct: the host's: replace, then remove, then add.
        numbers: (N,) int32, the rows before it.
    """
    import torch

    def carried(colour: Tensor) -> Tensor:
        return colour[:, 1, 0].contiguous().view(torch.int32)

    origins, fresh = numbers.clone(), torch.zeros_like(numbers, dtype=torch.bool)
    if instruct.replace_features_dc_mask is not None:
        origins[instruct.replace_features_dc_mask] = carried(instruct.replace_features_dc)
    if instruct.replace_scaling_mask is not None:  # first children, the relocated, their parents
        fresh |= instruct.replace_scaling_mask
    if instruct.remove_mask is not None:
        origins, fresh = origins[~instruct.remove_mask], fresh[~instruct.remove_mask]
    if instruct.new_features_dc is not None:
        if instruct.new_features_dc.shape[1] != 2:
            raise AlignmentError(
                "DensificationInstruct.new_features_dc",
                "rows that are not copies of the model's",
                "colours taken from the model by row",
                "Use one of the package's own densifiers.",
            )
        added = carried(instruct.new_features_dc)
        origins = torch.cat([origins, added])
        fresh = torch.cat([fresh, torch.ones_like(added, dtype=torch.bool)])
    return origins.long(), fresh


@hookimpl
def fragprune_register_adapters(register: Callable[[HostAdapter], None]) -> None:
    """Offer the pip package."""
    register(GaussianSplatting())
