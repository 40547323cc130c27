"""How a fork spells its rasterizer: aliases, modules, positions and two packages."""

import pytest
from miniatures.skeletons import SETTINGS, skeleton

from fragprune_graphdeco.call import drawing_functions, read_calls
from fragprune_plugins.hosts.source import HostRepo

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


@pytest.fixture(params=SPELLINGS)
def renderer(request, tmp_path):
    imports, settings, rasterizer = SPELLINGS[request.param]
    skeleton(tmp_path)
    (tmp_path / RENDERER / "__init__.py").write_text(
        f"{imports}\n\n\ndef render(viewpoint_camera, pc):\n    s = {settings}\n"
        f"    r = {rasterizer}(raster_settings=s)\n"
        "    image, radii, depth = r(means3D=pc.get_xyz, means2D=0, opacities=0)\n"
    )
    return HostRepo(tmp_path)


def test_a_rasterizer_is_read_however_it_is_spelled(renderer):
    assert drawing_functions(renderer, RENDERER) == ["render"]
    (found,) = read_calls(renderer, RENDERER, "render")
    assert (found.package, found.settings) == ("a_rasterizer", tuple(SETTINGS))
    assert found.names == ("image", "radii", "depth")
    assert set(found.given) == {"means3D", "means2D", "opacities", *SETTINGS}
