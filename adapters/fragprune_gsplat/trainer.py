"""gsplat's own training script, ``examples/simple_trainer.py`` of its repository.

It cannot resume a training: ``--ckpt`` names models to evaluate. So stage 2 follows stage 1 in one
run, which is as much longer. The script uses the installed gsplat; its folder needs none.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from fragprune_graphdeco import stand_ins
from fragprune_gsplat import DEFAULT, LPIPS, MCMC, Gsplat
from fragprune_gsplat.dialect import GsplatDialect
from fragprune_plugins.adapting import (
    CommandLine,
    HostCall,
    HostRepo,
    NotComparedError,
    Photographs,
    Role,
    ScriptAdapter,
    Seam,
    SeamCall,
    UsageError,
)

LISTS = {"eval_steps", "save_steps", "ply_steps"}  # at these it evaluates and saves
ONLY = {
    "steps-scaler": ("1", "1.0"),
    "compression": ("None",),
    "camera-model": ("pinhole",),
    "with-ut": ("False",),
    "with-eval3d": ("False",),
    "strategy.absgrad": ("False",),
    "app-opt": ("False",),  # colours of a network's, infinite where a point is black or white
}
"""Flags with values that stage 2 cannot follow; these values it can."""
NEAR = 0.01  # the near plane of ``rasterization``
BESIDE = ("post-processing", "use-bilateral-grid", "use-fused-bilagrid")  # these change colours
OFF = ["None"], ["False"]
IDENTITY = [[float(row == column) for column in range(4)] for row in range(4)]
_WHERE = "gsplat's simple_trainer"
_OWN_FIGURES = "Compare its own figures of held-out views, stats/val_step*.json in --result_dir."
DEFINES = ("create_splats_with_optimizers", "Runner.train", "main")


def recognised(script: Path) -> bool:
    """Whether a file is this script, in any of its versions; the one for surfels is another."""
    beside, name = HostRepo(script.parent), script.stem
    defined = all(beside.function(name, each) for each in DEFINES)
    states = "max_steps" in defaults(beside, name, "Config")
    return defined and states and bool(beside.calls(name, "rasterization"))


def defaults(repo: HostRepo, module: str, kind: str) -> dict[str, Any]:
    """The fields of a dataclass and their defaults, as source has them; None if no constant."""
    return {
        ast.unparse(line.target): getattr(line.value, "value", None)
        for line in getattr(repo.definition(module, kind), "body", ())
        if isinstance(line, ast.AnnAssign)
    }


def given(arguments: list[str]) -> dict[str, list[str]]:
    """The values of each flag by its name with dashes, the last of several; tyro takes both."""
    found: dict[str, list[str]] = {}
    values: list[str] = []
    for word in arguments:
        if word.startswith("--"):
            name, equals, value = word[2:].partition("=")
            values = found[name.replace("_", "-")] = [value] if equals else []
        else:
            values.append(word)
    return found


class TrainerDialect(GsplatDialect):
    """The dialect with a stand-in for the loss's kernel."""

    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """The stand-ins, by import name."""
        return {**super().modules(draw), **stand_ins.fused_ssim()}


class SimpleTrainer(Gsplat, ScriptAdapter):
    """The adapter of a copy of the script, with the installed gsplat."""

    def __init__(self, script: Path) -> None:
        self.script = script
        self.world: tuple[tuple[float, ...], ...] | None = None  # see ``Photographs``
        parser = "datasets.colmap", "Parser.__init__"
        scene = Seam(Role.SCENE, *parser, external=True, how=self._note_world)
        self.seams = (*Gsplat.seams, LPIPS, scene)

    def dialect(self, repo: HostRepo) -> TrainerDialect:
        """The installed version's."""
        plain = super().dialect(repo)
        return TrainerDialect(plain.alpha_max, plain.floor, plain.tight)

    def command_line(self, repo: HostRepo) -> CommandLine:
        """The script's flags, which tyro reads with dashes or underscores."""
        return CommandLine(
            scripts=(str(self.script),),
            iterations=("--max-steps", "--max_steps"),
            output=("--result-dir", "--result_dir"),
            source=("--data-dir", "--data_dir"),
            save_checkpoints="--save_steps",
            resume="--ckpt",
            default_iterations=self._fields()["max_steps"],
            one_run=True,
        )

    def refuse(self, repo: HostRepo, arguments: list[str], *, stage: str, device: str) -> None:
        """Refuse flags that stage 2 cannot follow, by UsageError.

        Absolute gradients are gsplat's own to compute, on a GPU and where no thresholds learn.
        """
        theirs = {"strategy.absgrad"} if device != "cpu" and stage != "joint" else set()
        for name, values in given(arguments).items():
            known = None if name in theirs else ONLY.get(name)
            if known and (values or ["True"])[0] not in known:
                where = f"simple_trainer --{name}"
                remedy = "Remove the flag, or train without fragprune."
                raise UsageError(where, " ".join(values) or "given", " or ".join(known), remedy)

    def lengthened(self, arguments: list[str], first: int, last: int) -> list[str]:
        """Arguments with which the script trains on until ``last``, and saves at ``first`` too.

        Checkpoints show nobody but gsplat what was trained, so PLYs as well where it writes them.
        """
        flags, out = given(arguments), [*arguments, "--max_steps", str(last)]
        if "save_ply" in self._fields() and flags.keys().isdisjoint({"save-ply", "no-save-ply"}):
            out.append("--save_ply")
        for name in LISTS & self._fields().keys():
            stated = {int(each) for each in flags.get(name.replace("_", "-"), ())}
            out += [f"--{name}", *map(str, sorted({first, last, *stated}))]
        return out

    def densified(self, repo: HostRepo, script: Path, arguments: list[str]) -> int | None:
        """The strategy's ``refine_stop_iter``."""
        if stated := given(arguments).get("strategy.refine-stop-iter"):
            return int(stated[0])
        default = DEFAULT, "DefaultStrategy"
        module, kind = (MCMC, "MCMCStrategy") if "mcmc" in arguments else default
        return defaults(repo, module, kind).get("refine_stop_iter")

    def _fields(self) -> dict[str, Any]:
        """The script's flags and their defaults."""
        return defaults(HostRepo(self.script.parent), self.script.stem, "Config")

    def photographs(self, repo: HostRepo, arguments: list[str]) -> Photographs:
        """The photographs, where the script trains by them alone and saved PLYs."""
        flags, defaults = given(arguments), self._fields()
        folder, out, factor = (
            flags.get(name.replace("_", "-"), [str(defaults[name])])[0]
            for name in ("data_dir", "result_dir", "data_factor")
        )
        beside = [each for each in BESIDE if flags.get(each, OFF[0]) not in OFF]
        found = [f"--{each}, which a PLY lacks" for each in beside]
        if not [*Path(out).rglob("ply/*.ply")]:
            found.append("checkpoints alone")
        if flags.get("data-type", ["colmap"]) != ["colmap"]:
            found.append("data of another kind than COLMAP's")
        if flags.get("test-every", ["8"]) != ["8"]:
            found.append("other held-out views than every eighth")
        if found:
            expected = "what the script reads by default, and --save_ply"
            raise NotComparedError(_WHERE, ", ".join(found), expected, _OWN_FIGURES)
        scene, images = Path(folder), "images" if factor == "1" else f"images_{factor}"
        if (scene / f"{images}_png").is_dir():  # it makes these itself in place of JPEGs
            images = f"{images}_png"
        return Photographs(scene, images=images, centred=False, opaque=True, world=self.world)

    def _note_world(self, call: SeamCall) -> None:
        """Keep what the reader of a scene did to the world: it turns and scales it by default."""
        world = call.instance.transform.tolist()
        self.world = None if world == IDENTITY else tuple(map(tuple, world))

    def drawing(self, repo: HostRepo, arguments: list[str]) -> dict[str, Any]:
        """Near plane, gsplat's cap on alpha, ``--antialiased``; no far plane: NotComparedError."""
        flags, names = given(arguments), [word.replace("_", "-") for word in arguments]
        if "far-plane" in flags:
            found = "a far plane, which our readers do not have"
            raise NotComparedError(_WHERE, found, "pictures as the script draws them", _OWN_FIGURES)
        near = flags.get("near-plane", [self._fields().get("near_plane", NEAR)])[0]
        rules: dict[str, Any] = {"near": float(near), "alpha_max": self.dialect(repo).alpha_max}
        asked = [name for name in names if name in ("--antialiased", "--no-antialiased")]
        if asked[-1:] == ["--antialiased"]:  # the last of several flags wins
            rules["compensation"] = "antialiasing"
        return rules

    def model_file(self, output: Path, iteration: int) -> Path:
        """The PLY of an iteration with ``--save_ply``, else its checkpoint."""
        ply = output / "ply" / f"point_cloud_{iteration - 1}.ply"
        return ply if ply.exists() else output / "ckpts" / f"ckpt_{iteration - 1}_rank0.pt"

    def save_model(self, model: Any, output: Path, iteration: int) -> Path:
        """Write a checkpoint as the script does."""
        path = output / "ckpts" / f"ckpt_{iteration - 1}_rank0.pt"
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save({"step": iteration - 1, "splats": model.state_dict()}, str(path))
        return path
