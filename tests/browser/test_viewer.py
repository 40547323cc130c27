"""The viewer draws what our engines draw, counts what it draws, and asks nobody for anything."""

from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch
from browser.chromium import opened, served
from browser.viewing import decibels, engine_frame, frame, hold, pixels, viewing, write_page
from finetune import tiny

from fragprune_plugins import Model, RasterInputs, ThresholdStore, View, load_dataset
from fragprune_plugins.workbench.models import formats
from fragprune_plugins.workbench.view.site import (
    Layer,
    compacted,
    make_site,
    save_site,
    single_page,
)

pytestmark = pytest.mark.browser

WIDTH, HEIGHT = 200, 150


def a_model(degree: int = 1, count: int = 300, seed: int = 3) -> Model:
    """Small and large, faint and opaque, near and far, some behind the camera."""
    stream = torch.Generator().manual_seed(seed)
    splat = tiny.random_model(count, degree, seed)
    splat.xyz.mul_(2.5)
    splat.scaling.add_(0.8 * torch.randn(count, 3, generator=stream) - 0.6)
    splat.opacity.copy_(2.5 * torch.randn(count, 1, generator=stream))
    thresholds = torch.rand(count, generator=stream) * 0.5 + 0.004
    return replace(splat, thresholds=ThresholdStore.from_falloff(thresholds))


def a_view(**lens: float) -> View:
    """From within the cloud of ``a_model``, off its middle; the principal point off centre."""
    camera = tiny.cameras()[1]
    return View.pinhole(
        camera.rotation.float(),
        torch.tensor([0.2, 0.1, 2.0]),
        width=WIDTH,
        height=HEIGHT,
        **{"fx": 150.0, "fy": 140.0, "cx": 96.0, "cy": 80.0, **lens},
        background=torch.tensor([0.1, 0.3, 0.2]),
    )


@pytest.mark.parametrize("degree", range(4))
def test_the_picture_is_our_engines(browser, tmp_path, degree):
    model, view = a_model(degree), a_view()
    write_page(tmp_path, [model], view)
    with viewing(browser, tmp_path) as tab:
        hold(tab, view)
        for layer, truncated in ((0, True), (1, False)):
            shown = frame(tab, view, layer)
            expected = engine_frame(model, view, truncated=truncated)
            # 8 bits alone leave 59 dB; pixels on the edge of an opaque Gaussian may differ.
            assert decibels(shown.image, expected) > 56
        assert tab.errors == tab.strangers == []


def boxes(model, view, *, truncated, large):
    """(H, W) counts of shapes around ellipses, and of ellipses, over pixel centres.

    Shapes are boxes, or octagons around ellipses of more than ``large`` square pixels.
    """
    inputs = scenes.cast(RasterInputs(view, model.splats()), torch.float64)
    found = scenes.footprints_of(inputs).splats
    cutoffs = 2 * torch.log(255 * found.opacities)  # behind the camera opacity is 0
    if truncated:
        cutoffs = torch.minimum(cutoffs, -2 * model.falloff.double().log())
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    quads, ellipses = np.zeros((2, HEIGHT, WIDTH))
    shapes = (found.means2d.numpy(), found.conics.numpy(), cutoffs.numpy())
    for mean, conic, cutoff in zip(*shapes, strict=True):
        if cutoff < 0:
            continue
        precision, axes = np.linalg.eigh([[conic[0], conic[1]], [conic[1], conic[2]]])
        offsets = np.stack([x - mean[0], y - mean[1]], axis=-1) @ axes * np.sqrt(precision)
        reaches = np.abs(offsets) / np.sqrt(cutoff)
        covered = (reaches <= 1).all(axis=-1)
        if 4 * cutoff / np.sqrt(precision.prod()) > large:
            covered &= reaches.sum(axis=-1) <= np.sqrt(2)
        quads += covered
        ellipses += (offsets**2).sum(axis=-1) <= cutoff
    return quads, ellipses


@pytest.mark.parametrize("large", [36, float("inf")])
@pytest.mark.parametrize("truncated", [True, False])
def test_quads_and_fragments_are_those_of_the_ellipses(browser, tmp_path, truncated, large):
    model, view = a_model(), a_view()
    write_page(tmp_path, [model], view)
    quads, ellipses = boxes(model, view, truncated=truncated, large=large)
    with viewing(browser, tmp_path) as tab:
        hold(tab, view)
        tab.run(
            f"() => {{ viewer.drawing.options.large = {str(large).replace('inf', 'Infinity')}; }}"
        )
        shown = frame(tab, view, 0 if truncated else 1, stop=False)
        # The rasterizer rounds corners to fractions of a pixel: a pixel on an edge may differ.
        for counted, expected in ((shown.quads, quads), (shown.fragments, ellipses)):
            assert counted.sum() == pytest.approx(expected.sum(), rel=2e-3)
            assert np.abs(counted - expected).mean() < 0.01 * expected.mean()
        total = tab.run(f"() => viewer.drawing.total([0, {WIDTH}])")
        assert (total["quads"], total["fragments"]) == (shown.quads.sum(), shown.fragments.sum())
        part = tab.run("() => viewer.drawing.total([37, 101])")
        assert part["quads"] == shown.quads[:, 37:101].sum()
        at = tab.run("() => viewer.drawing.countsAt(120, 30)")
        assert at == {"quads": shown.quads[30, 120], "fragments": shown.fragments[30, 120]}


def test_full_pixels_are_left_alone_and_look_the_same(browser, tmp_path):
    model, view = a_model(count=6000), a_view()
    write_page(tmp_path, [model], view)
    with viewing(browser, tmp_path) as tab:
        hold(tab, view)
        through, stopped = (frame(tab, view, 1, stop=stop) for stop in (False, True))
        assert stopped.quads.sum() < 0.8 * through.quads.sum()
        assert np.abs(stopped.image - through.image).max() <= 1.01 / 255


def test_pixels_stop_as_the_models_do_a_few_fragments_later(browser, tmp_path):
    view, stop = a_view(), 0.05
    stopped = a_model(count=6000).with_rules(stop=stop)
    write_page(tmp_path, [a_model(count=6000), stopped], view)
    with viewing(browser, tmp_path) as tab:
        hold(tab, view)
        through, soon = (frame(tab, view, layer) for layer in (0, 1))
    assert soon.fragments.sum() < 0.9 * through.fragments.sum()
    exact = engine_frame(stopped, view)
    assert decibels(soon.image, exact) > decibels(through.image, exact) + 1


def test_usual_quads_reach_as_far_for_every_gaussian(browser, tmp_path):
    model, view = a_model(), a_view()
    model.opacity.fill_(-3.0)  # faint ones end long before the square root of 8
    write_page(tmp_path, [model], view)
    quads = {}
    for options in ("", "quads=fixed"):
        with viewing(browser, tmp_path, options) as tab:
            hold(tab, view)
            quads[options] = frame(tab, view, 1, stop=False).quads.sum()
    assert quads["quads=fixed"] > 1.3 * quads[""]


def test_split_shows_each_side_as_it_is_alone(browser, tmp_path):
    one, two, view = a_model(seed=3), a_model(seed=4), a_view()
    write_page(tmp_path, [one, two], view)
    with viewing(browser, tmp_path) as tab:
        hold(tab, view)
        left, right = (frame(tab, view, layer).image for layer in (0, 1))
        tab.run(
            """() => {
                const [left, right] = viewer.layers;
                const both = [{ ...left, sides: [0, 77] }, { ...right, sides: [77, 200] }];
                viewer.drawing.draw(held, both);
            }"""
        )
        both = pixels(tab, [0.1, 0.3, 0.2], WIDTH)
        np.testing.assert_allclose(both[:, :77], left[:, :77], atol=1.01 / 255)
        np.testing.assert_allclose(both[:, 77:], right[:, 77:], atol=1.01 / 255)
        assert np.abs(left - right).mean() > 0.01


def test_hands_and_keys(browser, tmp_path):
    """Split, maps, cameras, photographs, orbit: each changes what it should, and nothing fails."""
    data, _, splat = tiny.scene(tmp_path / "scene")
    shown = load_dataset(data).test
    store = ThresholdStore.from_falloff(torch.full((len(splat),), 0.3))
    write_page(tmp_path / "page", [replace(splat, thresholds=store)], shown[0].view, shown)
    with viewing(browser, tmp_path / "page", width=800, height=600) as tab:
        page = tab.page
        page.wait_for_function("() => viewer.counted")
        cells = page.locator("#figures tbody td").all_inner_texts()
        assert float(cells[0]) < float(cells[1])
        assert cells[2].endswith("×")
        assert page.locator("#left").inner_text() == "truncated"

        page.locator("#split").focus()
        page.keyboard.press("ArrowLeft")
        assert page.locator("#split").get_attribute("aria-valuenow") == "48"
        page.keyboard.press("Tab")

        page.locator("#maps span", has_text="Quads").click()
        assert page.locator("#legend").is_visible()
        page.keyboard.press("o")
        page.keyboard.press("3")
        assert tab.run("() => [viewer.map, viewer.show]") == ["picture", "right"]

        page.locator("#cameras select").select_option("1")
        page.locator("#photo").click()
        page.wait_for_function("() => document.querySelector('#photograph img').naturalWidth > 0")

        before = tab.run("() => viewer.camera")
        page.mouse.move(600, 300)
        page.mouse.down()
        page.mouse.move(660, 330)
        page.mouse.up()
        after = tab.run("() => viewer.camera")
        distance = tab.run("() => viewer.distance")
        centres = [
            np.array(each["position"]) + distance * np.array(each["rotation"][6:])
            for each in (before, after)
        ]
        np.testing.assert_allclose(*centres, atol=1e-6)
        assert np.abs(np.subtract(before["position"], after["position"])).max() > 0.05
        turn = np.reshape(after["rotation"], (3, 3))
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)

        page.keyboard.down("w")
        page.wait_for_timeout(200)
        page.keyboard.up("w")
        assert tab.run("() => viewer.camera.position") != after["position"]
        page.keyboard.press("?")
        assert page.locator("#help").is_visible()
        page.keyboard.press("Escape")
        page.keyboard.press("t")
        page.wait_for_function("() => viewer.counted")
        assert tab.errors == tab.strangers == []


def test_slow_frames_stay_small_while_the_camera_turns(browser, tmp_path):
    """A hand waits for the frame it sees. The wait is no rest, which is drawn in full size.

    The page's clock is the test's, so a busy machine changes nothing.
    """
    write_page(tmp_path, [a_model()], a_view())
    with viewing(browser, tmp_path) as tab:
        tab.page.wait_for_function("() => viewer.counted")
        sizes = tab.run(
            """async () => {
                const { gl } = viewer.drawing, until = new Map(), sizes = [];
                let clock = performance.now();
                performance.now = () => clock;
                const real = { fence: gl.fenceSync, state: gl.getSyncParameter };
                gl.fenceSync = (...given) => {
                    const fence = real.fence.call(gl, ...given);
                    until.set(fence, clock + 400);  // longer than a hand may rest
                    return fence;
                };
                gl.getSyncParameter = (fence, name) =>
                    clock < until.get(fence) ? 0 : real.state.call(gl, fence, name);
                const draw = viewer.draw.bind(viewer);
                viewer.draw = (quality = 1) => { sizes.push(quality); draw(quality); };
                const frame = () => new Promise(done => requestAnimationFrame(done));
                viewer.quality = 0.5;
                for (let turn = 0; turn < 4; turn++) {
                    const { position } = viewer.camera, drawn = sizes.length;
                    viewer.go({ ...viewer.camera, position: position.map(each => each + 0.01) });
                    while (sizes.length === drawn) await frame();
                    while (viewer.pending) {
                        clock += 50;
                        await frame();
                    }
                    clock += 60;  // to see it, and to go on
                    for (let i = 0; i < 3; i++) await frame();
                }
                const turning = sizes.slice();
                clock += 1000;
                while (!viewer.sharp) await frame();
                return { turning, resting: sizes.at(-1) };
            }"""
        )
        assert len(sizes["turning"]) >= 4
        assert max(sizes["turning"]) <= 0.5
        assert sizes["resting"] == 1
        assert tab.errors == []


def test_one_page_from_disk_is_small_and_shows_the_same(browser, tmp_path):
    """Of a .spz file: there nothing is rounded once more."""
    file, view = tmp_path / "model.spz", a_view()
    formats.write(formats.named(file), file, a_model(3, count=3000))
    model, layers = formats.read(file), [Layer("whole", 0, False), Layer("cut", 0, True)]
    site = make_site("one", [model], layers, (), view)
    small, rounded = compacted(site)
    assert rounded == []
    page, shown = single_page(small), {}
    assert len(small["model-0.splats"]) < 1.3 * file.stat().st_size
    (tmp_path / "page.html").write_bytes(page)
    save_site(tmp_path / "raw", site)
    with served(tmp_path / "raw") as raw:
        for address in (raw, (tmp_path / "page.html").as_uri()):
            with opened(browser, address, width=320, height=240) as tab:
                tab.page.wait_for_function("() => window.viewer && viewer.layers.length === 2")
                hold(tab, view)
                shown[address] = [frame(tab, view, layer).image for layer in (0, 1)]
                assert tab.errors == tab.strangers == []
    for one, other in zip(*shown.values(), strict=True):
        assert np.abs(one - other).max() < 1.01 / 255
    assert decibels(shown[raw][1], engine_frame(model, view)) > 56


def test_a_damaged_page_says_so(browser, tmp_path):
    site = make_site("one", [a_model()], [Layer("it", 0, False)], (), a_view())
    small, _ = compacted(site)
    held = bytearray(small["model-0.splats"])
    held[len(held) // 2] ^= 0x55
    (tmp_path / "page.html").write_bytes(single_page({**small, "model-0.splats": bytes(held)}))
    with opened(browser, (tmp_path / "page.html").as_uri()) as tab:
        tab.page.wait_for_function("() => document.querySelector('#loading progress').hidden")
        assert "damaged" in tab.page.locator("#loading span").inner_text()


INTRUDE = """async () => {
    const refused = [];
    document.addEventListener("securitypolicyviolation", event =>
        refused.push(event.effectiveDirective));
    const added = document.createElement("div");
    added.innerHTML = "<img src='data:,' onerror='window.intruded = true'>"
        + "<img src='http://127.0.0.1:9/'><style>* { color: red }</style>"
        + "<iframe src='http://127.0.0.1:9/'></iframe>";
    document.body.append(added);
    const script = document.createElement("script");
    script.textContent = "window.intruded = true";
    document.body.append(script);
    await fetch("http://127.0.0.1:9/").catch(() => {});
    await new Promise(done => setTimeout(done, 300));
    return [refused.sort(), window.intruded ?? false];
}"""


@pytest.mark.parametrize("single", [True, False])
def test_what_somebody_put_into_the_page_neither_runs_nor_asks_anybody(browser, tmp_path, single):
    model, view = a_model(), a_view()
    site = make_site("one", [model], [Layer("it", 0, False)], (), view)
    save_site(tmp_path, {"index.html": single_page(compacted(site)[0])} if single else site)
    with served(tmp_path) as address, opened(browser, address) as tab:
        tab.page.wait_for_function("() => window.viewer && viewer.counted")
        assert tab.errors == []
        refused, intruded = tab.run(INTRUDE)
        assert not intruded
        assert tab.strangers == []
        expected = ["connect-src", "frame-src", "img-src", "script-src-attr", "script-src-elem"]
        assert refused == [*expected, "style-src-elem"]


def test_a_phone_has_picture_and_panel_and_no_scroll(browser, tmp_path):
    write_page(tmp_path, [a_model()], a_view())
    phone = {"width": 390, "height": 844, "has_touch": True, "is_mobile": True}
    with viewing(browser, tmp_path, **phone) as tab:
        tab.page.wait_for_function("() => viewer.counted")
        assert tab.run("() => document.documentElement.scrollWidth") == 390
        boxes = tab.run(
            """() => [...document.querySelectorAll("#panel, #panel button, #panel label")]
                .filter(each => each.offsetWidth)
                .map(each => each.getBoundingClientRect().toJSON())"""
        )
        assert all(box["left"] >= 0 and box["right"] <= 390 for box in boxes)
        panel = boxes[0]
        assert panel["top"] > 844 / 2
        assert np.ptp(tab.picture()[: int(panel["top"]) - 20], axis=(0, 1)).min() > 30
        tab.page.touchscreen.tap(200, 200)
        assert tab.errors == []


def test_a_model_that_is_cut_off_is_stated(browser, tmp_path):
    write_page(tmp_path, [a_model()], a_view())
    held = (tmp_path / "model-0.splats").read_bytes()
    (tmp_path / "model-0.splats").write_bytes(held[:-64])
    with served(tmp_path) as address, opened(browser, address) as tab:
        said = tab.page.locator("#loading span")
        tab.page.wait_for_function("() => document.querySelector('#loading progress').hidden")
        assert "cut off" in said.inner_text()
