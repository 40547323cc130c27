"""Writes the demo's page from the parts of every report and an introduction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.workbench.scenes.dataset import Shot, load_dataset

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.workbench.demo.scene import SceneSettings

LARGER = 3
"""How many times as wide and high the page's pictures are as the photographs of the training."""

_REPEATS = 20  # timed frames for each view

BANNER = "banner.jpg"
"""The picture that shows all of it at a glance: pictures and maps side by side."""

_INTRODUCTION = """A small training repository learned this room from ray-traced photographs. Then
every Gaussian learned how far it reaches; fragments beyond that are neither sorted nor blended. No
line of the repository was changed. The pictures are of held-out views, from which neither model
learned, {larger} times as wide and high as the photographs of the training."""

_YOUR_OWN = """fragprune run -- python train.py -s scene -m out
fragprune finetune point_cloud.ply --data scene --out pruned.ply
fragprune audit point_cloud.ply --out audit"""


@dataclass(frozen=True, eq=False)
class _Traced(Shot):
    """A view whose photograph was traced for the page.

    Attributes:
        picture: (3, H, W) RGB in [0, 1].
    """

    picture: Tensor

    @property
    def image(self) -> Tensor:
        return self.picture.to(self.view.background.device)


def write_page(
    out: Path,
    report: dict[str, Any],
    scene: Path,
    settings: SceneSettings,
    curves: list[dict[str, float]],
    engine: str,
    device: str,
) -> list[str]:
    """Write ``pictures/`` and ``index.html``.

    Args:
        out: the demo's folder.
        report: the measurements; "larger" is added, frame times of pictures as large as the page's.
        scene: folder of the photographs.
        settings: of the photographs.
        curves: the run's learning curves, one dict per step.
        engine: name of the engine that draws.
        device: device of the models.

    Returns:
        The files as paths relative to ``out``.
    """
    from fragprune_plugins.plugins.hooks import engine_for
    from fragprune_plugins.workbench.figures import page
    from fragprune_plugins.workbench.figures.evaluate import Candidate, frame_times
    from fragprune_plugins.workbench.figures.wording import frames, outcome
    from fragprune_plugins.workbench.models import model as models
    from fragprune_plugins.workbench.report import page as report_page

    pictures = out / "pictures"
    paths = (Path(report["model_before"]), Path(report["model_after"]))
    one, other = (models.load(path, device=device) for path in paths)
    before, after = Candidate(one.untruncated()), Candidate(other)
    shots, rasterizer = _larger(load_dataset(scene).test, settings), engine_for(engine, device)
    larger = frame_times(
        [before, after], [shot.view.to(device) for shot in shots], rasterizer, repeats=_REPEATS
    )
    size = f"{shots[0].view.width}x{shots[0].view.height}"
    report["larger"] = {"size": size} | dict(zip(("before", "after"), larger, strict=True))
    drawn = report_page.draw_views(pictures, before, after, shots, rasterizer)
    report_page.save_banner(pictures / BANNER, before, after, shots[0], rasterizer)
    files = [*drawn.files, BANNER]
    learning = []
    if curves and other.falloff is not None:
        report_page.save_learning(pictures / report_page.LEARNING, curves, other.falloff)
        files.append(report_page.LEARNING)
        source = f"pictures/{report_page.LEARNING}"
        said = "How it learned"
        learning = [page.heading(said), page.wide(source, said)]
    text = page.compose(
        title="The same picture from fewer fragments",
        quote=outcome("run", report, report["control"]),
        parts=[
            page.paragraph(_INTRODUCTION.format(larger=LARGER)),
            report_page.figures({"before": report["before"], "after": report["after"]}),
            page.paragraph(f"Of pictures as large as those below, {size}: {frames(*larger)}."),
            *report_page.views(drawn, lambda file: f"pictures/{file}"),
            *learning,
            page.heading("Your own"),
            page.code(_YOUR_OWN),
        ],
    )
    with replacing(out / "index.html") as path:
        path.write_text(text, encoding="utf-8")
    return [*(f"pictures/{file}" for file in files), "index.html"]


def _larger(shots: Sequence[Shot], settings: SceneSettings) -> list[Shot]:
    """The views that a page shows, with larger pictures, traced anew."""
    import torch

    from fragprune_plugins.learning.stage2 import evenly
    from fragprune_plugins.workbench.demo.room import furnish
    from fragprune_plugins.workbench.demo.scene import photograph, photos
    from fragprune_plugins.workbench.report.page import SHOWN

    world = furnish(settings.seed)
    width, height = LARGER * settings.width, LARGER * settings.height
    cameras = photos(replace(settings, width=width, height=height))
    named = {Path(each.name).stem: each for each in cameras}
    traced: list[Shot] = []
    for shot in evenly(shots, SHOWN):
        pixels = torch.from_numpy(photograph(world, named[Path(shot.name).stem], 2))
        view = replace(shot.view, width=width, height=height)
        traced.append(_Traced(shot.name, view, pixels.permute(2, 0, 1).float() / 255))
    return traced
