"""List entries that the cpu engine counts, against tiles that can be counted by hand."""

import pytest
import scenes
import torch

from fragprune_plugins.engines import create_engine
from fragprune_plugins.engines.cpu.engine import CpuEngine
from fragprune_plugins.types import Footprints, RasterInputs, View

SIDE = 64  # 4 x 4 tiles


def disc(x: float, y: float, sigma: float, opacity: float = 0.5) -> Footprints:
    """A round Gaussian on the image that may draw in any tile."""
    return Footprints(
        means2d=torch.tensor([[x, y]]),
        conics=torch.tensor([[sigma**-2, 0.0, sigma**-2]]),
        depths=torch.ones(1),
        opacities=torch.tensor([opacity]),
        colors=torch.ones(1, 3),
        tiles=torch.tensor([[0, 0, 4, 4]], dtype=torch.int32),
    )


def entries(splats: Footprints, threshold: float | None = None) -> float:
    cut = None if threshold is None else torch.full((len(splats),), threshold)
    size = {"width": SIDE, "height": SIDE}
    view = View.pinhole(torch.eye(3), torch.zeros(3), **size, fx=50.0, fy=50.0)
    drawn = CpuEngine().rasterize(RasterInputs(view, splats), cut)
    return drawn.entries_per_pixel * SIDE**2


@pytest.mark.parametrize(
    ("splats", "threshold", "expected"),
    [
        (disc(7.5, 7.5, 1.0), None, 1),
        (disc(15.5, 7.5, 1.0), None, 2),  # across one border
        (disc(15.5, 15.5, 1.0), None, 4),
        (disc(31.5, 31.5, 100.0), None, 16),  # everywhere
        (disc(31.5, 31.5, 100.0), 0.99, 4),  # a radius of 14 pixels
        (disc(7.5, 7.5, 1.0, opacity=0.003), None, 0),  # below 1/255
    ],
)
def test_a_disc_is_on_the_lists_of_the_tiles_that_it_reaches(splats, threshold, expected):
    assert entries(splats, threshold) == pytest.approx(expected)


def test_what_an_opaque_tile_hides_is_on_no_list_that_is_blended():
    wall = disc(31.5, 31.5, 1000.0, opacity=0.99)
    arrays = {k: v.repeat_interleave(2000, 0) for k, v in vars(wall).items() if v is not None}
    walls = Footprints(**arrays | {"depths": torch.arange(1.0, 2001.0)})
    assert entries(walls) < 16 * 2000 / 2


def test_more_threads_count_the_same_and_pairs_fit_their_entries():
    inputs = scenes.random_scene(3, 300, 90, 70)
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        found.append(CpuEngine().rasterize(inputs, None))
    assert found[0].entries_per_pixel == found[1].entries_per_pixel
    assert found[0].evaluated_per_pixel <= 256 * found[0].entries_per_pixel
    oracle = create_engine("reference").rasterize(inputs, None)
    assert found[0].entries_per_pixel <= oracle.entries_per_pixel  # whole tiles of a square
