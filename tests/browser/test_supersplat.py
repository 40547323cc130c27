"""SuperSplat, built in $FRAGPRUNE_RENDERERS/supersplat by its own means, edits a pruned file.

Nothing of it is here: without such a folder the tests are skipped.
"""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from browser.chromium import opened, served
from cli.commands import run_json
from finetune import tiny

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


@pytest.fixture
def built():
    folder = Path(os.environ.get("FRAGPRUNE_RENDERERS") or ".", "supersplat", "dist")
    if not (folder / "index.js").exists():
        pytest.skip("no supersplat/dist in $FRAGPRUNE_RENDERERS")
    return folder


def test_an_edited_file_gets_its_cutoffs_back(tmp_path, built, browser):
    pruned = tiny.cut(tiny.random_model(), torch.linspace(0.1, 0.9, 60)).with_rules(stop=0.02)
    site, edited, out = tmp_path / "site", tmp_path / "edited.ply", tmp_path / "out.ply"
    site.mkdir()
    for each in built.iterdir():
        (site / each.name).symlink_to(each)
    write_ply(site / "pruned.ply", pruned)
    with (
        served(site) as address,
        opened(browser, f"{address}?load=pruned.ply", service_workers="block") as tab,
    ):
        tab.page.wait_for_function("() => window.scene?.events.invoke('selection')")
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
