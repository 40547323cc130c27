"""PlayCanvas and Spark, unmodified from npm, draw our cutoffs through the bridges."""

import re
from pathlib import Path

import numpy as np
import pytest
from browser.chromium import opened, served
from browser.compared import COUNT, EDGE, HALF_PIXELS, a_model, a_view, falloffs, firm, ours, psnr
from browser.engines import NoEnginesError, drawing, engines, install
from cli.commands import run

from fragprune_plugins.workbench.models.cutoffs import decode, encode
from fragprune_plugins.workbench.models.formats.ply import write_ply

pytestmark = pytest.mark.browser
Error = pytest.importorskip("playwright.sync_api").Error

ROOT = Path(__file__).parents[2]
PLAYCANVAS = ["playcanvas", "playcanvas-webgpu", "playcanvas-webgpu-cpu"]
ENGINES = [*PLAYCANVAS, "spark"]
PACKAGES = ["playcanvas", "spark"]
each_engine = pytest.mark.parametrize("engine", ENGINES)
each_playcanvas = pytest.mark.parametrize("engine", PLAYCANVAS)
each_package = pytest.mark.parametrize("engine", PACKAGES)

DILATION = {**dict.fromkeys(PLAYCANVAS, HALF_PIXELS), "spark": 0.3}

FAR = [0, 0, -50]
"""A place behind the camera."""


@pytest.fixture(scope="session", autouse=True)
def installed():
    try:
        engines()
    except NoEnginesError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def splat(view):
    return a_model(view)


@pytest.fixture(scope="module")
def codes(splat):
    return encode(splat.falloff).tolist()


@pytest.fixture(scope="module")
def view():
    return a_view()


@pytest.fixture(scope="module")
def whole(splat, tmp_path_factory):
    """The file without cutoffs."""
    path = tmp_path_factory.mktemp("whole") / "model.ply"
    write_ply(path, splat.untruncated())
    return path


@pytest.fixture(scope="module")
def cut(splat, tmp_path_factory):
    """The file with the column of cutoffs."""
    path = tmp_path_factory.mktemp("cut") / "model.ply"
    write_ply(path, splat)
    return path


@pytest.fixture(scope="module")
def draw(browser, view):
    """A picture by an engine, (H, W, 3) uint8."""

    def picture(engine, model, view=view, **options):
        with drawing(browser, engine, model, view, **options) as page:
            return page.picture()

    return picture


@each_engine
@pytest.mark.parametrize("truncated", [False, True], ids=["whole", "cut"])
def test_the_picture_is_that_of_our_engine(draw, engine, truncated, splat, view, cut):
    """To 50 dB, and to 8 of 255 levels at 999 of 1,000 pixels, where no fragment is at its cutoff.

    The engines keep shapes in 16 bits, so Q is a few percent off where ellipses are long, and a
    fragment there may be drawn or not; the canvas rounds after every Gaussian.
    """
    tau = falloffs(splat, truncated)
    sure = firm(splat, view, DILATION[engine], tau)
    want = ours(splat, view, DILATION[engine], tau).image.permute(1, 2, 0).clamp(0, 1).numpy()
    have = draw(engine, cut, bridge=truncated, plain=True) / 255
    assert sure.mean() > 0.6
    assert psnr(have[sure], want[sure]) > 50
    assert (np.abs(have - want)[sure].max(axis=1) > 8 / 255).mean() < 0.001
    assert psnr(have, want) > 42


CONFORMING = 40
"""dB that the conformance files ask of a renderer."""


@each_engine
@pytest.mark.parametrize("name", ["rims", "faint", "cloud"])
def test_the_conformance_scenes_are_drawn_as_expected(draw, engine, name, tmp_path):
    """PlayCanvas draws the cloud's smallest Gaussians smaller than 3DGS does; see HALF_PIXELS."""
    conformance = pytest.importorskip("cutoff_files")
    splat, camera = conformance.scene(name), conformance.cameras()["front"]
    path = tmp_path / "scene.ply"
    write_ply(path, splat)
    have = draw(engine, path, camera.view(), bridge=True, plain=True) / 255
    want, _ = conformance.draw(splat, camera)
    if engine == "spark" or name != "cloud":
        assert psnr(have, want.permute(1, 2, 0).numpy()) > CONFORMING
    want = ours(splat, camera.view(), DILATION[engine], splat.falloff.clamp(min=EDGE)).image
    assert psnr(have, want.permute(1, 2, 0).clamp(0, 1).numpy()) > CONFORMING + 2


@each_engine
def test_quads_end_where_ellipses_do(browser, engine, splat, view, cut):
    """A rectangle around an ellipse has 4 / pi times its area."""
    tau = falloffs(splat)
    ellipses = int(ours(splat, view, DILATION[engine], tau).fragments.sum())
    with drawing(browser, engine, cut, view, bridge=True, plain=True) as page:
        quads = page.quads()["pixels"]
    assert quads == pytest.approx(4 / np.pi * ellipses, rel=0.03)


@each_engine
def test_a_file_without_cutoffs_is_drawn_as_ever_to_the_pixel(draw, engine, whole):
    assert (draw(engine, whole, bridge=True) == draw(engine, whole)).all()


@each_engine
@pytest.mark.parametrize("first", [False, True])
def test_a_model_without_cutoffs_beside_one_with_them_is_drawn_as_ever(draw, engine, first, cut):
    """Also its rows stay its own, whichever of the two the engine draws first."""
    seen = {"second": FAR, "hidden": "second", "first": first}
    alone = draw(engine, cut, bridge=True)
    assert (
        psnr(draw(engine, cut, bridge=True, **seen) / 255, alone / 255) > 50
    )  # PlayCanvas: sorting
    seen["hidden"] = "cut"
    assert (draw(engine, cut, bridge=True, **seen) == draw(engine, cut, **seen)).all()


@each_playcanvas
def test_code_0_changes_nothing_in_playcanvas(draw, engine, cut):
    neutral = draw(engine, cut, bridge=True, cutoffs=[0] * COUNT)
    assert (neutral == draw(engine, cut)).all()


@each_playcanvas
def test_pixels_that_quads_cover_become_fewer_in_playcanvas(browser, engine, view, cut):
    pixels = []
    for bridge in (False, True):
        with drawing(browser, engine, cut, view, bridge=bridge) as page:
            pixels.append(page.quads()["pixels"])
    assert pixels[0] > 2 * pixels[1] > 0


def test_code_0_leaves_out_what_is_below_1_in_255_in_spark(draw, cut):
    """Spark itself draws down to half of that."""
    neutral = draw("spark", cut, bridge=True, cutoffs=[0] * COUNT)
    bare = draw("spark", cut, spark={"minAlpha": 1 / 255})
    assert np.abs(neutral.astype(int) - bare).max() <= 1


@each_engine
def test_codes_in_the_order_of_the_file_equal_the_column(draw, engine, whole, cut, codes):
    """PlayCanvas reorders the rows as it loads them."""
    assert (draw(engine, whole, bridge=True, cutoffs=codes) == draw(engine, cut, bridge=True)).all()


@each_playcanvas
def test_rows_that_playcanvas_was_told_to_leave_in_order(draw, engine, whole, cut, codes):
    loaded = draw(engine, whole, bridge=True, cutoffs=codes, late=True, data={"reorder": False})
    assert (loaded == draw(engine, cut, bridge=True, data={"reorder": False})).all()


@each_playcanvas
def test_playcanvas_draws_the_cutoffs_of_a_sog(draw, engine, splat, codes, tmp_path):
    """The format reorders rows; a file keeps its codes in its own order, also without a column."""
    formats = pytest.importorskip("fragprune_plugins.workbench.models.formats")
    for name, each in (("cut", splat), ("whole", splat.untruncated())):
        path = tmp_path / f"{name}.sog"
        formats.write(formats.named(path), path, each)
    stored = encode(formats.read(tmp_path / "cut.sog").falloff).tolist()
    assert sorted(stored) == sorted(codes)
    assert stored != codes
    cut = draw(engine, tmp_path / "cut.sog", bridge=True)
    given = draw(engine, tmp_path / "whole.sog", bridge=True, cutoffs=stored)
    whole = draw(engine, tmp_path / "whole.sog", bridge=True)
    assert (cut == given).all()
    assert (whole == draw(engine, tmp_path / "whole.sog")).all()
    assert psnr(cut / 255, whole / 255) < 30


REFUSED = {
    "fewer codes": ("both", {"cutoffs": [1] * (COUNT - 1)}, "599 cutoffs for 600 splats"),
    "rows lost": ("playcanvas", {"cutoffs": [1] * COUNT, "late": True}, "reordered its rows"),
    "old renderer": ("playcanvas", {"component": {"unified": False}}, "unified: false"),
    "a chunk of one's own": ("playcanvas", {"chunks": {"gsplatCommonVS": ""}}, "has no places"),
    "a corner of one's own": (
        "playcanvas-webgpu",
        {"chunks": {"gsplatHybridVS": ""}},
        "gsplatHybridVS has no places",
    ),
    "a small device": ("playcanvas-webgpu", {"plain": True, "bytes": 32}, "takes 33"),
    "GLSL on WebGPU": ("playcanvas-webgpu", {"modifier": "void main() {}"}, "the modifier has no"),
    "a modifier that modifies nothing": ("playcanvas", {"modifier": ""}, "the modifier has no"),
    "level of detail": ("spark", {"mesh": {"lod": True, "nonLod": True}}, "has LoD"),
    "a shader of one's own": ("spark", {"spark": {"vertexShader": "void main() {}"}}, "no lines"),
    "other codes": ("spark", {"cutoffs": "column"}, "not a Uint8Array"),
}


@pytest.mark.parametrize(
    ("engine", "options", "told"),
    [
        pytest.param(engine, options, told, id=f"{name}-{engine}")
        for name, (which, options, told) in REFUSED.items()
        for engine in (PACKAGES if which == "both" else [which])
    ],
)
def test_what_cannot_work_is_refused_in_one_sentence(browser, engine, options, told, view, cut):
    supported = {
        "playcanvas": "PlayCanvas 2.23.3; supported: 2.20",
        "spark": "supported: @sparkjsdev",
    }
    with (
        pytest.raises(Error, match=told) as caught,
        drawing(browser, engine, cut, view, bridge=True, **options),
    ):
        pass
    assert "fragprune: " in str(caught.value)
    assert supported[engine.partition("-")[0]] in str(caught.value)


@each_package
def test_npm_installs_the_folder_of_a_bridge(engine, tmp_path):
    folder = run("bridge", engine).stdout.strip()
    install(tmp_path, "--prefix=.", "--offline", "--omit=peer", folder)
    package = tmp_path / "node_modules" / f"fragprune-{engine}"
    assert (package / f"fragprune-{engine}.mjs").is_file()


@each_package
def test_thresholds_have_the_same_codes_in_javascript(browser, engine, view, cut):
    tau = np.float32([0, 1e-9, 1 / 255, 0.989, 1, *np.geomspace(1 / 255, 1, 500)])
    tau = np.concatenate([tau, decode(np.arange(256))])
    with drawing(browser, engine, cut, view) as page:
        script = f"(async () => (await import('fragprune-{engine}')).encode)()"
        coded = page.tab.run(f"async tau => tau.map(await {script})", tau.tolist())
    assert coded == encode(tau).tolist()


def header(*columns, count=2, form="binary_little_endian"):
    lines = ["ply", f"format {form} 1.0", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property {column}" for column in columns), "end_header", ""])


@pytest.mark.parametrize(
    ("text", "body", "codes"),
    [
        (header("uchar a", "float trunc_threshold"), b"\0" + b"\0\0\x80\x3f" + b"\0" * 5, [255, 0]),
        (header("float x"), bytes(8), None),
        (header("float x", "float trunc_threshold"), bytes(15), "ends too early"),
        (header("double trunc_threshold"), bytes(16), "column trunc_threshold of double"),
        (header("float trunc_threshold", form="ascii"), b"1\n1\n", "ascii"),
        (header("float trunc_threshold"), b"\0\0\x80\xbf" * 2, "threshold -1"),
        ("not a ply", b"", "not a PLY"),
    ],
)
def test_spark_reads_the_column_of_a_ply(browser, view, cut, text, body, codes):
    script = """async bytes => {
        const { readCutoffs } = await import('fragprune-spark');
        const codes = readCutoffs(Uint8Array.from(bytes));
        return codes && Array.from(codes);
    }"""
    with drawing(browser, "spark", cut, view) as page:
        given = list(text.encode() + body)
        if isinstance(codes, str):
            with pytest.raises(Error, match=codes):
                page.tab.run(script, given)
        else:
            assert page.tab.run(script, given) == codes


@each_package
def test_the_page_of_the_how_to_works_as_it_stands(browser, engine, tmp_path, whole, cut):
    text = (ROOT / "docs" / "how-to" / f"{engine}.md").read_text()
    (page,) = re.findall(r"```html\n(.*?)```", text, re.DOTALL)
    shown = []
    for name, model in (("whole", whole), ("cut", cut)):
        folder = tmp_path / name
        run("bridge", engine, "--out", str(folder))
        (folder / "index.html").write_text(page + '<link rel="icon" href="data:,">')
        (folder / "pruned.ply").symlink_to(model)
        (folder / "node_modules").symlink_to(engines() / "node_modules")
        with served(folder) as address, opened(browser, address, width=160, height=120) as tab:
            for _ in range(40):
                tab.page.wait_for_timeout(500)
                last = tab.picture()
                if (last > 0).any():
                    break
            shown.append(last)
            assert tab.errors == tab.strangers == []
    assert (shown[0] > 0).mean() > (shown[1] > 0).mean() > 0.1
