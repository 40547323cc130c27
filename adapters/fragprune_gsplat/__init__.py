"""nerfstudio-project/gsplat: a library. The user writes the training loop and its command line.

A model is a ``ParameterDict`` with an optimizer per key. One function, ``rasterization``, projects
and draws; strategies change rows through a handful of functions that treat every key alike.
"""

from __future__ import annotations

import io
import os
from collections.abc import Hashable, Mapping
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fragprune_graphdeco import reading
from fragprune_plugins.adapting import (
    GROUPS,
    Finding,
    HostAdapter,
    HostInfo,
    HostRepo,
    InputError,
    ParamGroup,
    Role,
    ScriptAdapter,
    Seam,
    SeamCall,
    SessionError,
    revised,
)

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_gsplat.dialect import GsplatDialect

PACKAGE = "gsplat"
RENDERING, OPERATIONS = f"{PACKAGE}.rendering", f"{PACKAGE}.strategy.ops"
EXPORTER = f"{PACKAGE}.exporter"
BASE = f"{PACKAGE}.strategy.base"
REARRANGING = ("duplicate", "split", "remove", "relocate", "sample_add")
RELOCATED = ("opacities", "scales", "ratios", "binoms")
SHAPED = ("quats", "scales", "compute_covar", "compute_preci", "triu")
DEFAULT, MCMC = f"{PACKAGE}.strategy.default", f"{PACKAGE}.strategy.mcmc"
STRATEGIES = ("Strategy", "DefaultStrategy", "MCMCStrategy", "check_sanity")
"""What the loop of whoever uses it names, one of them, where a model is attached."""
DRAWN = ("means", "opacities", "viewmats", "Ks", "covars")  # arguments of ``rasterization``
LPIPS = Seam(
    Role.METRIC, "torchmetrics.image.lpip", "LearnedPerceptualImagePatchSimilarity", external=True
)
"""With what gsplat's trainer and nerfstudio measure."""
DRIFT = 1e-3  # how far the numbers of a pose that learns move from one visit to the next, at most
KEYS = ("means", "sh0", "shN", "opacities", "scales", "quats")
NAMES = {key: group.name for key, group in zip(KEYS, GROUPS, strict=True)}
"""What the rest of the field calls gsplat's keys."""


def optimizers(call: SeamCall) -> list[Any]:
    """The optimizers, one for each key."""
    return list(call.arguments["optimizers"].values())


def answered(module: str, name: str, *needs: str, by: str) -> Seam:
    """A function that one of ``answers`` answers, imported at the first call: it loads torch."""

    def how(call: SeamCall) -> Any:
        return getattr(import_module("fragprune_gsplat.answers"), by)(call)

    return Seam(Role.ANSWER, f"{PACKAGE}.{module}", name, needs, how=how)


def surfels(call: SeamCall) -> None:
    """Refuse a step of a training that draws surfels, which would count and learn nothing."""
    found, remedy = "surfels, which have no cutoffs here", "Train without fragprune, or train 2DGS "
    remedy += "in its own repository, which fragprune knows."
    raise InputError(str(call.seam), found, "gsplat.rasterization", remedy)


class Splats(dict[str, Any]):
    """Parameters in what is saved or was loaded; a session may ask whether it knows them."""

    __hash__ = object.__hash__  # type: ignore[assignment]


def splats_in(saved: Any) -> Splats | None:
    """The parameters in a dict, or in one inside it as gsplat's trainer has them; else None."""
    import torch

    kinds, names = (Mapping, torch.nn.ParameterDict), ("means", "quats", "opacities")
    found = [saved, *saved.values()] if isinstance(saved, kinds) else []
    for each in [part for part in found if isinstance(part, kinds)]:
        if all(isinstance(each.get(name), torch.Tensor) for name in names):
            return Splats(each)
    return None


def place(call: SeamCall) -> Any:
    """The path of the file that ``torch.save`` or ``torch.load`` got, or has open; else None."""
    file = call.arguments["f"]
    plain = io.BufferedReader, io.BufferedWriter, io.BufferedRandom, io.FileIO
    file = file.name if isinstance(file, plain) else file
    return file if isinstance(file, str | os.PathLike) else None


def exported(call: SeamCall) -> Any:
    """Where ``export_splats`` writes; None for the formats but PLY, which sort their rows."""
    return call.arguments["save_to"] if call.arguments["format"] == "ply" else None


def read_again(call: SeamCall) -> tuple[Path, Tensor] | None:
    """The file and its means, if ``torch.load`` read parameters from one."""
    file, splats = place(call), splats_in(call.result)
    return (Path(file), splats["means"].detach().cpu()) if splats and file else None


class Gsplat(HostAdapter):
    """The adapter of gsplat."""

    name = "gsplat"
    info = HostInfo(
        "gsplat",
        repo="nerfstudio-project/gsplat",
        states="1.4, 1.5, 1.6 (pinhole cameras)",
        limits=(
            "Refused by name: other cameras, distortion, the unscented transform, distributed, "
            "batches, channels other than three, tiles other than 16 pixels, rasterization_2dgs.",
            "absgrad is refused before stage 2 on a CPU, and where thresholds learn inside the "
            "training; several GPUs in one training are refused.",
            "Its own examples/simple_trainer.py cannot resume: both stages are one run.",
        ),
    )
    installed = (PACKAGE,)
    steps_by_rendering = True
    groups = (*HostAdapter.groups, ParamGroup("colors", colour=True))
    seams: tuple[Seam, ...] = (
        Seam(Role.RASTERIZE, RENDERING, "rasterization", DRAWN),
        Seam(Role.VIEW, RENDERING, "rasterization", ("viewmats",)),
        Seam(Role.VIEW, RENDERING, "rasterization_2dgs", ("viewmats",), how=surfels),
        Seam(Role.LOSS, "torch", "Tensor.backward", external=True),
        Seam(Role.ATTACH, BASE, "Strategy.check_sanity", ("params", "optimizers"), how=optimizers),
        *(Seam(Role.REARRANGE, OPERATIONS, name, ("params",)) for name in REARRANGING),
        Seam(Role.STILL, OPERATIONS, "reset_opa", ("params",)),
        Seam(Role.STILL, OPERATIONS, "inject_noise_to_position", ("params",)),
        Seam(Role.STILL, DEFAULT, "DefaultStrategy.step_pre_backward", ("params",)),
        Seam(Role.STILL, DEFAULT, "DefaultStrategy.step_post_backward", ("params",)),
        Seam(Role.STILL, MCMC, "MCMCStrategy.step_post_backward", ("params",)),
        answered("relocation", "compute_relocation", *RELOCATED, by="relocation"),
        answered("cuda._wrapper", "quat_scale_to_covar_preci", *SHAPED, by="covariance"),
        answered("distributed", "cli", "fn", "args", by="alone"),
        Seam(Role.SAVE, "torch", "save", ("f", "obj"), external=True, how=place),
        Seam(Role.UNPACK, "torch", "load", ("f",), external=True, how=read_again),
        Seam(Role.SAVE, EXPORTER, "export_splats", ("save_to", "means", "format"), how=exported),
    )

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """Likewise; scripts that import it and no strategy are a host of its own, to which no model
        is attached.
        """
        found, scripts = super().fingerprint(repo), (each.stem for each in repo.root.glob("*.py"))
        if repo.package or reading.mentions(repo, reading.reached(repo, scripts), STRATEGIES):
            return found
        what, expected = f"draws by {PACKAGE} without its strategies", "a loop with a strategy"
        return [Finding.error("own-host", repo.root, what, expected), *found]

    def seams_for(self, repo: HostRepo) -> tuple[Seam, ...]:
        """All; versions before 1.5.1 export nothing."""
        exports = repo.path(EXPORTER) is not None
        return self.seams if exports else revised(self.seams, {"export_splats": None})

    def dialect(self, repo: HostRepo) -> GsplatDialect:
        """The version's dialect, read off its source.

        Until 1.4 extents are squares of 3 sigma. Until 1.5 alpha's cap is 0.999, and antialiasing
        has no floor.
        """
        from fragprune_gsplat.dialect import GsplatDialect

        if repo.path(f"{PACKAGE}.cuda._constants"):
            return GsplatDialect(alpha_max=0.99, floor=0.005, tight=True)
        projects = repo.parameters(f"{PACKAGE}.cuda._wrapper", "fully_fused_projection") or ()
        return GsplatDialect(alpha_max=0.999, floor=0.0, tight="opacities" in projects)

    def trainer(self, repo: HostRepo, script: Path) -> ScriptAdapter | None:
        """The adapter of gsplat's own training script, if this is it."""
        from fragprune_gsplat import trainer

        return trainer.SimpleTrainer(script) if trainer.recognised(script) else None

    def model_of(self, call: SeamCall) -> Any:
        """The dict that a strategy changes, the means if a call has only them, or what is saved.

        What is saved is often a copy, in which the session looks for the Gaussians of a model.
        """
        import torch

        given = call.arguments
        if "obj" in given or "save_to" in given:  # of torch.save, and of export_splats
            return splats_in(given.get("obj", given))
        params = given.get("params", given.get("means"))
        if isinstance(params, dict):
            found = "a plain dict, which cannot hold a session's state"
            remedy = "Convert it: params = torch.nn.ParameterDict(params)."
            raise SessionError("params", found, "torch.nn.ParameterDict", remedy)
        return params if isinstance(params, torch.nn.ParameterDict | torch.Tensor) else None

    def group_name(self, model: Any, group: Mapping[str, Any]) -> str | None:
        """The name of the group's parameter, because users name groups freely or not at all."""
        (parameter,) = group["params"]
        return next((NAMES.get(key, key) for key, own in model.items() if own is parameter), None)

    def means(self, model: Any) -> Tensor:
        """(N, 3) the parameter itself."""
        means: Tensor = model["means"]
        return means

    def opacities(self, model: Any) -> Tensor:
        """(N,) after the sigmoid."""
        opacities: Tensor = model["opacities"]
        return opacities.detach().sigmoid().reshape(-1)

    def view(self, camera: Tensor) -> Hashable:
        """A key from each camera's numbers, because loaders make a new tensor for every step."""
        poses = camera.detach().cpu()
        if camera.requires_grad:
            keys = tuple(map(self._learned_pose, poses))
        else:
            keys = tuple(hash(each.numpy().tobytes()) for each in poses)
        if len(keys) > 1:  # several pictures of one camera are pictures of the whole call
            return keys if len(set(keys)) == len(keys) else hash(keys)
        return keys[0]

    @cached_property
    def _poses(self) -> list[Tensor]:
        """Poses that learn, each as it was last drawn."""
        return []

    def _learned_pose(self, pose: Tensor) -> int:
        """The number of a pose that moves a little from visit to visit."""
        import torch

        number = len(self._poses)
        if number:
            away = (pose - torch.stack(self._poses)).abs().amax(dim=(1, 2))
            number = int(away.argmin()) if away.min() < DRIFT else number
        self._poses[number : number + 1] = [pose]
        return number
