"""How a fork spells its rasterizer: aliases, modules, positions and two packages."""

import pytest
from miniatures.skeletons import SETTINGS, skeleton

from fragprune_graphdeco.call import drawing_functions, read_calls

RENDERER = "gaussian_renderer"
NAMED = ", ".join(f"{name}=0" for name in SETTINGS)
SPELLINGS = {
    "an alias": (
        "from a_rasterizer import GaussianRasterizationSettings as S, GaussianRasterizer as R",
        f"S({NAMED})",
        "R",
    ),
    "a module": (
        "import a_rasterizer as dgr",
        f"dgr.GaussianRasterizationSettings({NAMED})",
        "dgr.GaussianRasterizer",
    ),
    "positions": (
        "from a_rasterizer import GaussianRasterizationSettings, GaussianRasterizer",
        f"GaussianRasterizationSettings({', '.join('0' * len(SETTINGS))})",
        "GaussianRasterizer",
    ),
    "another rasterizer's settings": (
        "from b import GaussianRasterizationSettings as S, GaussianRasterizer\n"
        "from a_rasterizer import GaussianRasterizer as Modified",
        f"S({NAMED})",
        "Modified",
    ),
}


@pytest.mark.parametrize("how", SPELLINGS)
def test_a_rasterizer_is_read_however_it_is_spelled(tmp_path, how):
    imports, settings, rasterizer = SPELLINGS[how]
    repo = skeleton(tmp_path)
    (tmp_path / RENDERER / "__init__.py").write_text(
        f"{imports}\n\n\ndef render(viewpoint_camera, pc):\n    s = {settings}\n"
        f"    r = {rasterizer}(raster_settings=s)\n"
        "    image, radii, depth = r(means3D=pc.get_xyz, means2D=0, opacities=0)\n"
    )
    assert drawing_functions(repo, RENDERER) == ["render"]
    (found,) = read_calls(repo, RENDERER, "render")
    assert (found.package, found.settings) == ("a_rasterizer", tuple(SETTINGS))
    assert found.names == ("image", "radii", "depth")
    assert set(found.given) == {"means3D", "means2D", "opacities", *SETTINGS}
