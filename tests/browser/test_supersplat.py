"""SuperSplat, built in $FRAGPRUNE_RENDERERS by its own means, edits a pruned file and draws it.

``supersplat/dist`` is a build as it is, ``supersplat-cutoffs/dist`` one whose drawing is changed as
docs/how-to/renderers.md says. Nothing of either is here: without them the tests are skipped.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser.chromium import Tab, opened, served
from browser.compared import HALF_PIXELS, a_model, a_view, falloffs, firm, ours, psnr
from browser.engines import placed
from cli.commands import run_json
from finetune import tiny

from fragprune_plugins import Model, ThresholdStore, View
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.workbench.models.formats.ply import write_ply

pytestmark = pytest.mark.browser

SPLAT = "scene.events.invoke('scene.splats')[0]"

EDIT = f"""() => {{
    const splat = {SPLAT};
    const {{ x, y, z }} = splat.entity.getLocalPosition();
    const Vec3 = splat.entity.getLocalPosition().constructor;
    splat.move(new Vec3(x + 1, y - 2, z + 3), undefined, new Vec3(2, 2, 2));
    const third = new Uint8Array(splat.splatData.numSplats).map((_, i) => (i % 3 ? 0 : 255));
    scene.events.fire("select.mask", "set", third);
}}"""
"""What people do there: move and enlarge the model, and select Gaussians."""

DELETE = "() => scene.events.fire('select.delete')"

SAVE = """() => scene.events.invoke(
    "scene.write", "ply", { filename: "edited.ply", splatIdx: "all", serializeSettings: {} }
)"""


PLACE = f"""async ({{ matrix, fov }}) => {{
    const {{ entity }} = {SPLAT}, {{ instance }} = entity.gsplat;
    const pose = entity.getWorldTransform().clone();
    pose.mul(pose.clone().set(matrix));
    const rotation = entity.getLocalRotation().clone().setFromMat4(pose);
    const sorted = new Promise(done => instance.sorter.once("updated", done));
    scene.camera.setPoseOverride({{
        position: pose.getTranslation(), rotation, fov, near: 0.01, far: 1000
    }});
    instance.sort(scene.camera.mainCamera);
    await Promise.race([sorted, new Promise(done => setTimeout(done, 5000))]);
}}"""
"""The order of depth may be that of before, which nothing tells: hence the race."""

DRAW = """(async (width, height) => {
    const { camera } = scene;
    camera.startOffscreenMode(width, height);
    camera.renderOverlays = scene.gizmoLayer.enabled = false;
    const drawn = new Promise(done => scene.events.once("postrender", done));
    scene.forceRender = true;
    await drawn;
    const data = new Uint16Array(width * height * 4), renderTarget = camera.mainTarget;
    await renderTarget.colorBuffer.read(0, 0, width, height, { renderTarget, data });
    camera.endOffscreenMode();
    return data;
})"""
"""Half floats, as it blends them; bottom row first."""

CHANGE = f"""([found, instead]) => {{
    const {{ material }} = {SPLAT}.entity.gsplat.instance;
    const chunks = material.shaderChunks.glsl, text = chunks.get("gsplatPS");
    if (text.split(found).length !== 2) throw new Error(`not one "${{found}}"`);
    chunks.set("gsplatPS", text.replace(found, instead));
    material.update();
}}"""
"""A line of the fragment shader."""

UNFADED = ["(exp(x * -4.0) - EXP4) * INV_EXP4", "exp(x * -4.0)"]
"""Its kernel falls to 0 at the edge of the quad; ours does not."""

COUNTED = [
    "void main(void) {",
    """void main(void) {
    pcFragColor0 = vec4(1.0, 0.0, 0.0, 0.0);
    pcFragColor1 = vec4(0.0);
    return;""",
]
"""Red 1 and alpha 0 are blended as a sum."""


def built(name: str) -> Path:
    folder = Path(os.environ.get("FRAGPRUNE_RENDERERS") or ".", name, "dist")
    if not (folder / "index.js").exists():
        pytest.skip(f"no {name}/dist in $FRAGPRUNE_RENDERERS")
    return folder


@contextmanager
def editing(browser: Any, build: Path, site: Path, model: Model) -> Iterator[Tab]:
    """Its page with this model open, served from a folder to make."""
    site.mkdir()
    for each in build.iterdir():
        (site / each.name).symlink_to(each)
    write_ply(site / "pruned.ply", model)
    with (
        served(site) as address,
        opened(browser, f"{address}?load=pruned.ply", service_workers="block") as tab,
    ):
        tab.page.wait_for_function("() => window.scene?.events.invoke('selection')")
        yield tab


def drawn(tab: Tab, view: View) -> np.ndarray:
    """What it draws from a camera, (H, W, 4)."""
    wider = max(view.tan_fov_x, view.tan_fov_y)
    fov = float(2 * np.degrees(np.arctan(wider)))
    tab.run(PLACE, {"matrix": placed(view), "fov": fov})
    pixels = tab.array(f"{DRAW}({view.width}, {view.height})").view(np.float16)
    return pixels.reshape(view.height, view.width, 4)[::-1].astype(np.float32)


def test_neutral_cutoffs_are_drawn_as_ever_to_the_bit(tmp_path, browser):
    plain, changed = built("supersplat"), built("supersplat-cutoffs")
    view = a_view()
    pruned = a_model(view)
    neutral = ThresholdStore.from_falloff(torch.full((len(pruned),), 1 / 255))
    shown = {}
    for name, build, model in (
        ("before", plain, pruned),  # which draws no cutoffs
        ("neutral", changed, replace(pruned, thresholds=neutral)),
        ("none", changed, pruned.untruncated()),
    ):
        with editing(browser, build, tmp_path / name, model) as tab:
            shown[name] = drawn(tab, view)
    assert shown["before"].max() > 0.5
    assert np.array_equal(shown["before"], shown["neutral"])
    assert np.array_equal(shown["before"], shown["none"])


def test_cutoffs_are_drawn_as_our_engine_does_by_smaller_quads(tmp_path, browser):
    """A rectangle around an ellipse has 4 / pi times its area."""
    view = a_view()
    pruned = a_model(view)
    tau = pruned.falloff.clamp(min=falloffs(pruned, False).min())
    with editing(browser, built("supersplat-cutoffs"), tmp_path / "site", pruned) as tab:
        tab.run(CHANGE, UNFADED)
        have = drawn(tab, view)[..., :3].clip(0, 1)
        tab.run(CHANGE, COUNTED)
        quads = drawn(tab, view)[..., 0].sum()
    want = ours(pruned, view, HALF_PIXELS, tau)
    picture = want.image.permute(1, 2, 0).clamp(0, 1).numpy()
    sure = firm(pruned, view, HALF_PIXELS, tau)
    assert psnr(have[sure], picture[sure]) > 50
    assert psnr(have, picture) > 42
    assert quads == pytest.approx(4 / np.pi * int(want.fragments.sum()), rel=0.03)


def test_an_edited_file_gets_its_cutoffs_back(tmp_path, browser):
    pruned = tiny.cut(tiny.random_model(), torch.linspace(0.1, 0.9, 60)).with_rules(stop=0.02)
    site, edited, out = tmp_path / "site", tmp_path / "edited.ply", tmp_path / "out.ply"
    with editing(browser, built("supersplat"), site, pruned) as tab:
        opened_with = tab.array(f"{SPLAT}.splatData.getProp('trunc_threshold')")
        tab.run(EDIT)
        tab.page.wait_for_function(f"() => {SPLAT}.state.numSelected === 20")
        tab.run(DELETE)
        tab.page.wait_for_function(f"() => {SPLAT}.state.numDeleted === 20")
        with tab.page.expect_download() as download:
            tab.run(SAVE)
        download.value.save_as(edited)
    assert np.array_equal(np.sort(opened_with), pruned.falloff.numpy())
    assert read_ply(edited).falloff is None
    run_json("export", edited, site / "pruned.ply", "--out", out)
    got = read_ply(out)
    assert (len(got), got.stop) == (40, 0.02)
    own = [int((pruned.opacity[:, 0] == each).nonzero()) for each in got.opacity[:, 0]]
    assert torch.equal(got.falloff, pruned.falloff[own])
    assert len(set(own)) == 40
    torch.testing.assert_close(got.scaling, pruned.scaling[own] + np.log(2).astype(np.float32))
