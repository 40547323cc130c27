"""graphdeco-inria/gaussian-splatting: 3D Gaussian Splatting, the host the others descend from.

Its states are told apart by their source alone. Those of 2023 have two rasterizer outputs: the one
of mid-July no ``debug`` among the settings, that of late July no random background, that of October
both. That of August 2024 has exposure, depth and antialiasing, that of October 2024 ``separate_sh``
and sparse Adam. The first ten days of July 2023 knew no checkpoints, and so know no stage 2.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fragprune_plugins.adapting import (
    Finding,
    GraphdecoAdapter,
    HostAdapter,
    HostInfo,
    HostRepo,
    RasterizerCall,
    graphdeco,
    hookimpl,
)

OUTPUTS = 3
"""Colour, radii and, since August 2024, inverse depth."""


class Vanilla3DGS(GraphdecoAdapter):
    """Vanilla 3DGS, every public state."""

    name = "vanilla-3dgs"
    info = HostInfo(
        "3D Gaussian Splatting",
        repo="graphdeco-inria/gaussian-splatting",
        states="mid-July, late July, October 2023 (2-tuple), August 2024 (3-tuple), October 2024 "
        "(separate_sh, sparse Adam)",
        limits=("With --antialiasing or --train_test_exp run does not compare before and after.",),
    )
    calls = (
        RasterizerCall(),
        RasterizerCall(frozenset({"antialiasing"}), OUTPUTS, arguments=frozenset({"dc"})),
    )

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """The revision, where nothing speaks against this host."""
        return super().fingerprint(repo) or [self._state(repo)]

    def _state(self, repo: HostRepo) -> Finding:
        """The revision, for people; an error where it has no checkpoints to resume."""
        names = ("training_setup", "capture", "restore")
        there = [name for name in names if repo.function(graphdeco.MODEL, f"GaussianModel.{name}")]
        if there != ["training_setup"]:
            return Finding("info", "revision", str(repo.root), self.revision(repo))
        return Finding(
            "error",
            "revision",
            repo.place(graphdeco.MODEL, "GaussianModel"),
            "neither capture nor restore, as vanilla 3DGS was until 14 July 2023",
            "checkpoints, which stage 2 resumes",
            "Bring the fork to a later state, or give its PLY to fragprune finetune.",
        )

    def revision(self, repo: HostRepo) -> str:
        """Which of the public states the source is."""
        dialect = self.dialect(repo)
        if dialect.outputs < OUTPUTS:
            if "debug" not in dialect.settings:
                return "mid-July 2023"
            later = repo.mentions(["arguments"], ["random_background"])
            return "October 2023" if later else "late July 2023"
        has_separate_sh = "separate_sh" in (repo.parameters("gaussian_renderer", "render") or ())
        return "October 2024" if has_separate_sh else "August 2024"

    def prepare_stage2(self, model: Any, output: Path | None) -> None:
        """Bring exposures back: the host's checkpoint lacks them and a resumed run starts anew."""
        import torch

        mapping = getattr(model, "exposure_mapping", None)
        file = output / "exposure.json" if output else None
        if not mapping or file is None or not file.exists():
            return
        saved = json.loads(file.read_text())
        with torch.no_grad():
            for image, row in mapping.items():
                if image in saved:
                    model._exposure[row] = torch.tensor(saved[image]).to(model._exposure)


@hookimpl
def fragprune_register_adapters(register: Callable[[HostAdapter], None]) -> None:
    """Offer vanilla 3DGS."""
    register(Vanilla3DGS())
