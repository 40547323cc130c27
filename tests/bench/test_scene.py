"""The bench scene is the same everywhere: figures from two machines are of the same work."""

import hashlib

import pytest
import torch

from fragprune_plugins import Model, RasterInputs
from fragprune_plugins.engines import create_engine
from fragprune_plugins.workbench.bench.scene import make_scene, make_view

COLUMNS = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")
DIGEST = "f817cb6da8fd62dc50b6708bc3d1ff33eb9ef1bac9659ece73ee8aaf77c8b582"
"""Of make_scene(1000). Computed in float64 and rounded to float32, so that another library's last
digit changes no bit. If it changes all the same, published figures are of another scene."""


def digest(scene: Model) -> str:
    found = hashlib.sha256()
    for name in COLUMNS:
        found.update(getattr(scene, name).numpy().astype("<f4").tobytes())
    return found.hexdigest()


def test_the_arrays_have_the_stored_digest() -> None:
    assert digest(make_scene(1000)) == DIGEST


def test_another_seed_is_another_scene() -> None:
    assert digest(make_scene(50, seed=1)) != digest(make_scene(50, seed=2))
    assert digest(make_scene(50)) == digest(make_scene(50))


@pytest.mark.parametrize("count", [1, 7, 64])
def test_any_count(count: int) -> None:
    scene = make_scene(count)
    assert scene.xyz.shape == (count, 3)
    assert scene.f_rest.shape == (count, 15, 3)
    assert all(getattr(scene, name).isfinite().all() for name in COLUMNS)


@pytest.mark.parametrize("size", [(80, 60), (161, 120)])
def test_the_camera_sees_the_scene_at_any_size(size: tuple[int, int]) -> None:
    view = make_view(*size)
    assert view.tan_fov_x == pytest.approx(0.6)
    assert torch.equal(view.background, torch.zeros(3))
    out = create_engine("auto").rasterize(RasterInputs(view, make_scene(4000).splats()), None)
    assert (out.radii > 0).double().mean() > 0.6
    assert out.fragments_per_pixel > 5
