"""graphdeco-inria/gaussian-splatting: 3D Gaussian Splatting, the host the others descend from.

The source alone tells the states apart. The states of 2023 have two rasterizer outputs. Mid-July
lacks the setting ``debug``, late July lacks the random background, and October has both. August
2024 has exposure, depth and antialiasing. October 2024 has ``separate_sh`` and sparse Adam. States
before mid-July 2023 have no checkpoints, so stage 2 is not possible.
"""

from __future__ import annotations

import contextlib
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fragprune_graphdeco as graphdeco
from fragprune_3dgs_fork import ForkAdapter
from fragprune_3dgs_fork.methods import STATISTICS
from fragprune_3dgs_fork.read import read_fork
from fragprune_graphdeco import GraphdecoAdapter, RasterizerCall, reading
from fragprune_plugins.adapting import (
    Finding,
    HostInfo,
    HostRepo,
    ModelFileError,
    Role,
    SeamCall,
    UntrustedFile,
    revised,
)

if TYPE_CHECKING:
    from torch import Tensor

_EXPOSURES = UntrustedFile(
    ModelFileError,
    "not readable as exposures",
    "the exposure.json that the host wrote",
    "Remove it to begin with neutral exposures.",
)

OUTPUTS = 3  # colour, radii and, since August 2024, inverse depth
_KEPT = ".exposure.json"  # beside a PLY: what it had before stage 2 wrote its own


def _kept(ply: Path) -> Path | None:
    """The file of exposures that is kept beside a PLY; None if there is none of this PLY."""
    path = ply.with_suffix(_KEPT)
    there = path.exists() and ply.exists() and path.stat().st_mtime_ns >= ply.stat().st_mtime_ns
    return path if there else None


def _exposures(file: Path) -> dict[str, Tensor]:
    """A (3, 4) matrix for each photograph, by its name."""
    import torch

    found = {}
    with _EXPOSURES.reading(file) as reading:
        for image, rows in reading.json().items():
            reading.place = image
            found[image] = torch.tensor(rows).reshape(3, 4)
    return found


def _loaded(call: SeamCall) -> Path:
    """The file that was read; its model is shown under the exposures that it was trained with."""
    path, shown = Path(call.first), getattr(call.model, "pretrained_exposures", None)
    if shown and (kept := _kept(path)):
        for image, exposure in _exposures(kept).items():
            shown[image] = exposure.to(shown.get(image, exposure))
    return path


class Vanilla3DGS(GraphdecoAdapter):
    """The adapter of vanilla 3DGS, in every public state."""

    name = "vanilla-3dgs"
    descends_from = ("3dgs-fork",)
    info = HostInfo(
        "3D Gaussian Splatting",
        repo="graphdeco-inria/gaussian-splatting",
        states="mid-July, late July, October 2023 (2-tuple), August 2024 (3-tuple), October 2024 "
        "(separate_sh, sparse Adam)",
        limits=("fragprune run makes no comparison with --train_test_exp.",),
    )
    calls = (
        RasterizerCall(),
        RasterizerCall(frozenset({"antialiasing"}), OUTPUTS, arguments=frozenset({"dc"})),
    )

    seams = revised(GraphdecoAdapter.seams, {"GaussianModel.load_ply": {"how": _loaded}})

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """Check the source, as of a fork too; a finding names the revision."""
        found = super().fingerprint(repo)
        for further in (self._further, self._state):
            found += [] if any(each.level == "error" for each in found) else further(repo)
        return found

    def _further(self, repo: HostRepo) -> list[Finding]:
        """What a fork of this interface does otherwise: ``3dgs-fork`` serves it, or nobody does."""
        fork = read_fork(repo)
        if not fork.scripts:  # another model is trained, or no file of that name is Python
            trains = repo.tree("train") is None or reading.training_scripts(repo)
            return fork.errors if trains else []
        held = (seam for seam in self.seams if seam.role is Role.STILL)
        known = {seam.attribute.rpartition(".")[2] for seam in held} | STATISTICS
        trained = dict.fromkeys(fork.scripts, "another training script") | fork.unserved
        usual = [name for name in self.scripts if name in fork.scripts]
        what = [f"{name}: {why}" for name, why in trained.items() if name not in usual]
        what += [f"{name}, which changes the model" for name in fork.still if name not in known]
        what += [fork.one_run] if fork.one_run else []
        given = len(reading.state(repo.function(graphdeco.MODEL, "GaussianModel.capture")))
        what += [f"capture gives {given} values"] if given not in (0, 12) else []
        about, steps = ("other-host", str(repo.root)), "the steps of 3DGS alone"
        found = ForkAdapter().fingerprint(repo)  # groups were checked: here they need no names
        served = [each for each in found if each.code != "param-groups"]
        return served + [Finding.error(*about, each, steps) for each in what]

    def options(self, repo: HostRepo) -> frozenset[str]:
        """Those of a fork that was read, but for the optimizer, which is known."""
        return (super().options(repo) | read_fork(repo).options) - {"optimizer_type"}

    def _state(self, repo: HostRepo) -> list[Finding]:
        """A finding that names the revision; an error if it has no checkpoints."""
        names = ("training_setup", "capture", "restore")
        there = [name for name in names if repo.function(graphdeco.MODEL, f"GaussianModel.{name}")]
        if there != ["training_setup"]:
            return [Finding("info", "revision", str(repo.root), self.revision(repo))]
        at = repo.place(graphdeco.MODEL, "GaussianModel")
        found = "neither capture nor restore, as vanilla 3DGS was until 14 July 2023"
        remedy = "Bring the fork to a later state, or give its PLY to fragprune finetune."
        expected = "checkpoints, which stage 2 resumes"
        return [Finding.error("revision", at, found, expected, remedy)]

    def revision(self, repo: HostRepo) -> str:
        """The public state of the source."""
        dialect = self.dialect(repo)
        if dialect.outputs < OUTPUTS:
            if "debug" not in dialect.settings:
                return "mid-July 2023"
            later = reading.mentions(repo, ["arguments"], ["random_background"])
            return "October 2023" if later else "late July 2023"
        has_separate_sh = "separate_sh" in (repo.parameters("gaussian_renderer", "render") or ())
        return "October 2024" if has_separate_sh else "August 2024"

    def prepare_stage2(self, model: Any, start: Path | None) -> None:
        """Restore exposures, which the host's checkpoint lacks.

        Stage 2 writes its own over them, so they are kept beside the PLY of the start.
        """
        import torch

        mapping = getattr(model, "exposure_mapping", None)
        if not mapping or start is None:
            return
        ply, folder = start.absolute(), start.absolute().parent
        if ply.suffix == ".ply":
            folder = ply.parents[2]
        else:
            ply = self.model_file(folder, int(re.sub(r"\D", "", start.stem) or 0))
        kept = _kept(ply)
        if kept is None and not (folder / "exposure.json").exists():
            return
        saved = _exposures(kept or folder / "exposure.json")
        with torch.no_grad():
            for image, row in mapping.items():
                if image in saved:
                    model._exposure[row] = saved[image].to(model._exposure)
            neutral = torch.eye(3, 4).to(model._exposure)
        if kept is None and bool((model._exposure != neutral).any()):
            with contextlib.suppress(OSError):  # of somebody else's folder
                shutil.copy(folder / "exposure.json", ply.with_suffix(_KEPT))
