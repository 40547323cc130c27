"""hustvl/4DGaussians: Gaussians that a network moves, turns and scales with time.

A training has two phases in one process, each of which counts its iterations from 1. "coarse"
trains still Gaussians. "fine" also trains the network, which changes them for each view's moment.
Stage 2 belongs to "fine" alone. The phase is an argument of ``render``, so the first view drawn in
an iteration tells whether a step of stage 2 begins.

The PLY holds the Gaussians as the network finds them, which no moment shows. The network lies
beside it, in ``deformation.pth``.
"""

from __future__ import annotations

import ast
import os
import re
import runpy
from argparse import ArgumentParser
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fragprune_3dgs_fork.holding import HoldingAdapter
from fragprune_graphdeco import GraphdecoAdapter, GraphdecoDialect, RasterizerCall, model_seam
from fragprune_plugins.adapting import (
    ConfigFile,
    Finding,
    HostCall,
    HostInfo,
    HostRepo,
    ModelFileError,
    ParamGroup,
    RasterInputs,
    Role,
    SeamCall,
    UntrustedFile,
    UsageError,
    revised,
)

OUTPUTS = 3  # colour, radii and depth
STATE = 12  # the place of the optimizer's state in a checkpoint

_NETWORK = UntrustedFile(
    ModelFileError,
    "not readable as a part of the model",
    "deformation.pth and deformation_table.pth, which the host writes beside a PLY",
    "Name a checkpoint instead.",
)

GROUPS = ("OptimizationParams", "ModelHiddenParams", "ModelParams", "PipelineParams")
"""The dicts of a configuration that the host reads, in its order. An argument's last value wins."""


class PythonFile(ConfigFile):
    """A Python file that assigns dicts, and may name files in ``_base_`` that it builds on.

    It is run, as the host does: with mmcv 1, and its forks with mmengine or a reader of their own.
    """

    def read(self, path: Path) -> dict[str, Any]:
        """Values by argument name."""
        groups = _groups(path)
        return {key: value for name in GROUPS for key, value in groups.get(name, {}).items()}

    def copied(self, path: Path, values: dict[str, Any]) -> str:
        """A file that builds on the given one, and has the new values in the group that wins."""
        return f"_base_ = [{str(path.resolve())!r}]\n{GROUPS[-1]} = {values!r}\n"


def _groups(path: Path) -> dict[str, dict[str, Any]]:
    """The dicts of a file over those of the files that it builds on."""
    own = runpy.run_path(str(path))
    bases = own.get("_base_", [])
    paths = [bases] if isinstance(bases, str) else bases
    groups: dict[str, dict[str, Any]] = {}
    for each in [*(_groups(path.parent / base) for base in paths), own]:
        groups |= {name: groups.get(name, {}) | each[name] for name in GROUPS if name in each}
    return groups


@dataclass(frozen=True)
class MovingDialect(GraphdecoDialect):
    """Vanilla's call of 2023 with depth."""

    unneeded = {"open3d": {}, "lpips": {}, "tkinter": {"W": "w"}}  # not used to train or draw
    returned = ("image", "radii", "depth")

    def unpack(self, call: HostCall) -> RasterInputs:
        """Translate the call; matrices of PanopticSports scenes have a dimension of size 1 more."""
        s = call.settings
        flat = {name: getattr(s, name).reshape(4, 4) for name in ("viewmatrix", "projmatrix")}
        return super().unpack(replace(call, settings=s._replace(**flat)))


def completed(call: SeamCall) -> Any:
    """Add to a checkpoint made from a PLY the new model's extent, and groups as its network has."""
    capture = list(call.first)
    if not capture[STATE]["param_groups"]:
        capture[STATE] = capture[STATE] | call.model.optimizer.state_dict()
        capture[-1] = call.model.spatial_lr_scale
    return tuple(capture)


def is_fine(call: SeamCall) -> bool:
    """Whether a view is of the phase "fine", whose iterations are steps."""
    return "fine" in call.arguments["stage"]


class MovingGaussians(HoldingAdapter):
    """The adapter of 4DGaussians."""

    name = "4dgaussians"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "4DGaussians",
        repo="hustvl/4DGaussians",
        states="October 2024",
        limits=(
            "Its PLY alone is no model: fragprune finetune, render and compare refuse it; its own "
            "render.py draws it with thresholds.",
            "merge_many_4dgs.py and export_perframe_3DGS.py ignore thresholds.",
            "No path of an output folder may contain 'coarse', which the host takes for a phase.",
        ),
    )
    calls = (RasterizerCall(outputs=OUTPUTS),)
    groups = (
        GraphdecoAdapter.groups[0],
        ParamGroup("deformation", scheduled=True),
        ParamGroup("grid", scheduled=True),
        *GraphdecoAdapter.groups[1:],
    )
    drawn_from = ("_deformation",)
    own_names = ("save_deformation", "_deformation_table")
    dialect_type = MovingDialect
    undrawn = (
        "Gaussians that a network moves for each moment",
        "Draw with fragprune run -- python render.py -m OUTPUT --skip_train --skip_video; "
        "the host's metrics.py measures the pictures.",
    )
    steps_by_rendering = True
    flags = {"config": PythonFile("--configs"), "made": ".fragprune_fine_{}.pth", "hold_out": ()}
    checkpoints = "chkpnt_fine_"
    seams = (
        *revised(
            GraphdecoAdapter.seams,
            {
                "GaussianModel.update_learning_rate": None,  # it does not know the phase
                "GaussianModel.densify_and_prune": {"attribute": "GaussianModel.densify"},
                "GaussianModel.restore": {"how": completed},
                "render": {"needs": ("viewpoint_camera", "pc", "stage"), "how": is_fine},
            },
        ),
        model_seam(Role.STILL, "prune"),
    )

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """Also that its script trains "fine", to which stage 2 belongs, and names it."""
        text = ast.unparse(repo.tree("train") or ast.Pass())
        missing = [] if re.search(r"[(,] ?'fine'", text) else ["no phase fine in train.py"]
        missing += [] if "_{stage}_" in text else ["no checkpoints of a phase in train.py"]
        return [*super().fingerprint(repo), *self.other_host(repo, missing)]

    def resumed_by(self, script: Path, arguments: list[str]) -> tuple[Path, list[str]]:
        """The same command, with the folder that ``--expname`` means, or UsageError."""
        parser = ArgumentParser(add_help=False)
        parser.add_argument("-m", "--model_path", default="")
        parser.add_argument("--expname", default="")
        flags, _ = parser.parse_known_args(arguments)
        named = bool(flags.model_path) or not flags.expname
        folder = flags.model_path if named else os.path.join("output", flags.expname)
        self.expect_resumable(Path(folder, f"{self.checkpoints}0.pth"))
        return script, arguments if named else [*arguments, "--model_path", folder]

    def expect_resumable(self, checkpoint: Path) -> None:
        """Raise UsageError unless the host takes a checkpoint for one of "fine".

        The host looks for the words "coarse" and "fine" in the whole path.
        """
        path = str(checkpoint)
        if "fine" in path and "coarse" not in path:
            return
        found = "a path that the host misreads"
        remedy = "Rename the file or its folder, or name it by a shorter path."
        if checkpoint.name.startswith("chkpnt_coarse"):
            found = "a checkpoint of the phase coarse"
            remedy = "Finish the training first, with --stage off."
        expected = "a path with 'fine' and without 'coarse', by which the host tells phases apart"
        raise UsageError(path, found, expected, remedy)

    def view(self, camera: Any) -> int:
        """The camera's number, because the host copies cameras and loads them again.

        Cameras of PanopticSports are dicts without: their moment and place tell them apart.
        """
        if isinstance(camera, dict):
            place = camera["camera"].viewmatrix.flatten().tolist()
            return hash((camera["time"], *place))
        return int(camera.uid)

    def save_model(self, model: Any, output: Path, iteration: int) -> Path:
        """Save PLY and network, as ``scene.save`` does."""
        path = super().save_model(model, output, iteration)
        model.save_deformation(str(path.parent))
        return path

    def captured(self, ply: Path) -> tuple[Any, ...]:
        """The host's ``capture`` of a PLY and of the network beside it; see ``completed``."""
        degree, means, *rest, state, extent = super().captured(ply)
        network, table = (_part(ply, name) for name in ("deformation", "deformation_table"))
        unknown: dict[str, Any] = {"state": {}, "param_groups": []}
        return degree, means, network, table, *rest, state | unknown, extent


def _part(ply: Path, name: str) -> Any:
    """A file that the host wrote beside a PLY."""
    import torch

    with _NETWORK.reading(ply.with_name(f"{name}.pth")) as reading:
        return torch.load(reading.file, map_location="cpu", weights_only=True)
