"""More scenes against the oracle in float64: stops on tile borders, no size at all, near plane.

The rules of test_against_oracle.py apply: both engines see the same float32 numbers, and pixels
whose fragment counts differ by rounding are few and left out.
"""

import math
from dataclasses import replace

import scenes
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from native.test_against_oracle import check_gradients, check_images, draw_pair

from fragprune_plugins.constants import NEAR, TILE
from fragprune_plugins.engines.cpu.engine import CpuEngine
from fragprune_plugins.types import RasterInputs

Drawn = tuple[RasterInputs, torch.Tensor | None]


def placed(
    scene: RasterInputs, pixels: torch.Tensor, depths: torch.Tensor, sigma: torch.Tensor
) -> RasterInputs:
    """The same splats of a scene in float64, at other places and sigma pixels (N, 3) large."""
    view = scene.view
    scales = sigma * (depths.abs() * 2 * view.tan_fov_x / view.width)[:, None]
    means = scenes.unproject(view, pixels, depths)
    return replace(scene, splats=replace(scene.splats, means=means, scales=scales))


def uniform(seed: int, low: float, high: float, *shape: int) -> torch.Tensor:
    """Numbers in float64."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*shape, generator=generator, dtype=torch.float64) * (high - low) + low


@st.composite
def opaque_borders(draw: st.DrawFn) -> Drawn:
    """Opaque splats piled on the borders of tiles: pixels beside one another stop, in four tiles.

    Images end inside a tile, and some lists are longer than one batch of the engine.
    """
    seed, n = draw(st.integers(0, 2**20)), draw(st.sampled_from([8, 60, 300]))
    size = draw(st.sampled_from([(17, 19), (31, 33), (47, 18), (40, 50)]))
    scene = scenes.random_scene(seed, n, *size, colors=True, dtype=torch.float64)
    corners = torch.tensor(size).double() / TILE
    border = (uniform(seed, 0.4, 1.0, n, 2) * corners).round() * TILE - 0.5
    pixels = border + uniform(seed + 1, -1.0, 1.0, n, 2)
    sigma = uniform(seed + 2, math.log(0.7), math.log(12.0), n, 3).exp()
    scene = placed(scene, pixels, uniform(seed + 3, 1.0, 6.0, n), sigma)
    scene = replace(scene, splats=replace(scene.splats, opacities=uniform(seed + 4, 0.5, 1.0, n)))
    thresholds = scenes.random_thresholds(n, n) if draw(st.booleans()) else None
    return scenes.cast(scene, torch.float32), thresholds


@settings(max_examples=25)
@given(case=opaque_borders())
def test_pixels_stop_alike_on_both_sides_of_a_border(engine: CpuEngine, case: Drawn) -> None:
    truth, ours, same = draw_pair(engine, *case)
    check_images(truth, ours, same)
    # One fragment where the rim's reach ends, 4% of the peak, may count for one engine only.
    check_gradients(engine, *case, same, tolerance=1e-2)
    if case[1] is None and len(case[0].splats) == 300:
        assert (truth.alpha > 0.999).sum() > 10  # the pile is deep enough to stop pixels


@st.composite
def near_the_near_plane(draw: st.DrawFn) -> Drawn:
    """Gaussians just before and just behind the near plane, on the image and far beside it."""
    seed, n = draw(st.integers(0, 2**20)), draw(st.sampled_from([1, 2, 9]))
    size = draw(st.sampled_from([(1, 40), (33, 1), (30, 23)]))
    scene = scenes.random_scene(seed, n, *size, colors=True, dtype=torch.float64)
    side = uniform(seed, -1.0, 1.0, n).sign()
    depths = NEAR + side * uniform(seed + 1, math.log(1e-4), math.log(0.1), n).exp()
    pixels = uniform(seed + 2, -1.5, 2.5, n, 2) * torch.tensor(size)
    sigma = uniform(seed + 3, math.log(0.1), math.log(50.0), n, 3).exp()
    return scenes.cast(placed(scene, pixels, depths, sigma), torch.float32), None


@settings(max_examples=30)
@given(case=near_the_near_plane())
def test_the_near_plane_culls_alike(engine: CpuEngine, case: Drawn) -> None:
    truth, ours, same = draw_pair(engine, *case)
    assert torch.equal(truth.radii > 0, ours.radii > 0)
    if not torch.equal(truth.radii, ours.radii):
        return
    # A depth of 0.2 is what is left of coordinates of 2: ten times the usual rounding, all through.
    check_images(truth, ours, same, tolerance=2e-4)
    check_gradients(engine, *case, same, tolerance=3e-3)
