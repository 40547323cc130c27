"""docs/how-to/renderers.md against checkouts of these renderers, in $FRAGPRUNE_RENDERERS."""

import ctypes
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

PAGE = Path(__file__).parents[3] / "how-to" / "renderers.md"
ROWS = re.findall(r"^\| (.+?), \S+ \| `(.+?)` \| (.+?) \|", PAGE.read_text("utf-8"), re.MULTILINE)
FOLDERS = {"gsplat": "gsplat", "Faster-GS": "faster-gaussian-splatting", "SuperSplat": "supersplat"}

CUDA = """
#include <algorithm>
#include <cmath>
#define __device__
#define __forceinline__ inline
#undef __expf
#define __expf expf
using std::min;
typedef unsigned int uint;
struct float2 { float x, y; };
struct float3 { float x, y, z; };
typedef float3 vec3;
static float2 make_float2(float x, float y) { return {x, y}; }
static float2 operator-(float2 a, float2 b) { return {a.x - b.x, a.y - b.y}; }
static float2 operator+(float2 a, float2 b) { return {a.x + b.x, a.y + b.y}; }
static float2 operator*(float2 a, float2 b) { return {a.x * b.x, a.y * b.y}; }
static float lerp(float a, float b, float t) { return a + t * (b - a); }
static float __saturatef(float x) { return std::min(1.0f, std::max(0.0f, x)); }
"""


def text_of(renderer: str, file: str) -> str:
    folder = os.environ.get("FRAGPRUNE_RENDERERS")
    checkout = Path(folder or ".", FOLDERS[renderer])
    if not folder or not checkout.is_dir():
        pytest.skip(f"no checkout of {renderer} in $FRAGPRUNE_RENDERERS")
    return (checkout / file).read_text("utf-8")


def compiled(folder: Path, source: str) -> ctypes.CDLL:
    compiler = shutil.which("c++") or pytest.skip("no C++ compiler")
    (folder / "it.cpp").write_text(CUDA + source)
    words = [
        "-std=c++17",
        "-O1",
        "-w",
        "-shared",
        "-fPIC",
        folder / "it.cpp",
        "-o",
        folder / "it.so",
    ]
    subprocess.run([compiler, *words], check=True)
    return ctypes.CDLL(str(folder / "it.so"))


def test_every_renderer_has_places_in_the_table():
    assert {renderer for renderer, *_ in ROWS} == FOLDERS.keys()


@pytest.mark.parametrize(("renderer", "file", "what"), ROWS)
def test_what_decides_is_where_the_page_says(renderer, file, what):
    text = text_of(renderer, file)
    assert [name for name in re.findall(r"`(.+?)`", what) if name not in text] == []


@pytest.fixture
def gaussians():
    """Means, conics, opacities, thresholds, and the least alphas of the page, of 400 Gaussians."""
    stream = np.random.default_rng(0)
    means = stream.uniform(-30, 60, (400, 2))
    roots = stream.normal(0, 3, (400, 2, 2))
    inverse = np.linalg.inv(roots @ roots.transpose(0, 2, 1) + 0.3 * np.eye(2))
    opacities, thresholds = stream.uniform(0.01, 1, 400), stream.uniform(0, 0.98, 400) ** 3
    conics = inverse[:, [0, 0, 1], [0, 1, 1]]
    return means, conics, opacities, thresholds, (opacities * thresholds).clip(1 / 255, 0.99)


def fragments(gaussians, pixels):
    """(N, P) by the rule: falloff over threshold, alpha over 1/255, each in float64."""
    means, (a, b, c), opacities, thresholds, _ = (
        gaussians[0],
        gaussians[1].T[..., None],
        *gaussians[2:],
    )
    x, y = (pixels[None] - means[:, None]).transpose(2, 0, 1)
    falloff = np.exp(-0.5 * (a * x * x + 2 * b * x * y + c * y * y))
    drawn = (falloff >= thresholds[:, None]) & (opacities[:, None] * falloff >= 1 / 255)
    return drawn, falloff


def test_gsplat_draws_the_rule_with_a_number_for_each_gaussian(tmp_path, gaussians):
    text = text_of("gsplat", "gsplat/cuda/csrc/RasterizeToPixels3DGSDevice.cuh")
    its_own = re.search(r"struct GaussianWeight.*?\n}\n", text, re.DOTALL)[0]
    library = compiled(
        tmp_path,
        "static float least;\n#define ALPHA_THRESHOLD least\n#define MAX_ALPHA 0.999f\n"
        f"{its_own}"
        'extern "C" int drawn(float a, float b, float c, float x, float y, float o, float with) {'
        "least = with; return eval_gaussian_weight({a, b, c}, x, y, o).valid; }",
    )
    numbers = [ctypes.c_float] * 7
    library.drawn.argtypes = numbers
    means, conics, opacities, _, least = gaussians
    pixels = (
        np.stack(np.meshgrid(np.arange(0, 32, 3), np.arange(0, 24, 3)), -1).reshape(-1, 2) + 0.5
    )
    expected, falloff = fragments(gaussians, pixels)
    near = np.abs(opacities[:, None] * falloff / least[:, None] - 1) < 1e-4  # rounding decides
    got = np.array(
        [
            [library.drawn(*conic, *(mean - pixel), o, a) for pixel in pixels]
            for mean, conic, o, a in zip(means, conics, opacities, least, strict=True)
        ]
    )
    assert 0.001 < expected.mean() < 0.5
    assert ((got != expected) & ~near).sum() == 0


def test_faster_gs_lists_every_tile_with_a_fragment_and_fewer_than_before(tmp_path, gaussians):
    folder = "FasterGSCudaBackend/FasterGSCudaBackend/rasterization/include"
    text = text_of("Faster-GS", f"{folder}/kernel_utils.cuh")
    its_own = re.search(r"inline bool will_primitive_contribute\(.*?\n    }\n", text, re.DOTALL)[0]
    library = compiled(
        tmp_path,
        "namespace config { const int tile_width = 16, tile_height = 12; }\n"
        f"{its_own}"
        'extern "C" int listed(float x, float y, float a, float b, float c, float power) {'
        "return will_primitive_contribute({x, y}, {a, b, c}, 1, 1, power); }",
    )
    library.listed.argtypes = [ctypes.c_float] * 6
    means, conics, opacities, _, least = gaussians
    inside = np.stack(np.meshgrid(np.arange(16, 32), np.arange(12, 24)), -1).reshape(-1, 2)
    needed = fragments(gaussians, inside)[0].any(axis=1)

    def lists(bound):
        powers = np.log(opacities / bound)
        rows = zip(means, conics, powers, strict=True)
        return np.array([bool(library.listed(*mean, *conic, power)) for mean, conic, power in rows])

    before, after = lists(1 / 255), lists(least)
    assert not (needed & ~after).any()
    assert needed.sum() <= after.sum() < 0.9 * before.sum()
