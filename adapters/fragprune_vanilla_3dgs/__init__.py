"""graphdeco-inria/gaussian-splatting: 3D Gaussian Splatting, the host the others descend from.

Its states are told apart by their source alone: the first (2023, two rasterizer outputs), the one
of August 2024 (exposure, depth, antialiasing) and the one of October 2024 (``separate_sh``,
sparse Adam).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fragprune_plugins.adapter import HostAdapter, HostInfo
from fragprune_plugins.detect import Finding, HostRepo
from fragprune_plugins.hookspecs import hookimpl
from fragprune_plugins.lineage import Contract, GraphdecoAdapter

OUTPUTS = 3
"""Colour, radii and, since August 2024, inverse depth."""

OTHER_HOSTS = {
    "compute_3D_filter": "Mip-Splatting",
    "relocate_gs": "3DGS-MCMC",
    "divide_ratio": "RAIN-GS",
    "count_render": "LightGaussian",
    "render_imp": "Mini-Splatting",
    "get_marginal_t": "RT-4DGS",
    "bw_score": "LP-3DGS",
    "kernel_times": "Speedy-Splat",
    "vq_scale": "Compact-3DGS",
    "clamp_color": "c3dgs",
    "get_view2gaussian": "Gaussian Opacity Fields",
    "depth_ratio": "2D Gaussian Splatting",
    "_deformation": "4DGaussians",
}
"""Names that vanilla does not have and a descendant does."""


class Vanilla3DGS(GraphdecoAdapter):
    """Vanilla 3DGS, every public state."""

    name = "vanilla-3dgs"
    info = HostInfo(
        "3D Gaussian Splatting",
        repo="graphdeco-inria/gaussian-splatting",
        states="2023 (2-tuple), August 2024 (3-tuple), October 2024 (separate_sh, sparse Adam)",
        limits=("With --antialiasing or --train_test_exp run does not compare before and after.",),
    )
    contracts = (Contract(), Contract(frozenset({"antialiasing"}), OUTPUTS))

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """The revision found, or the descendant whose names occur."""
        mentioned = repo.mentions(
            ("train", "gaussian_renderer", "scene.gaussian_model"), OTHER_HOSTS
        )
        findings = [
            Finding(
                "error",
                "other-host",
                where,
                f"{name}, which belongs to {OTHER_HOSTS[name]}",
                "a vanilla 3DGS checkout",
                "Use the adapter of that host.",
            )
            for name, where in mentioned.items()
        ]
        missing = super().fingerprint(repo)
        revision = Finding("info", "revision", str(repo.root), self.revision(repo))
        return [*findings, *(missing or [revision])]

    def revision(self, repo: HostRepo) -> str:
        """Which of the public states the source is."""
        if self.dialect(repo).outputs < OUTPUTS:
            return "2023"
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
