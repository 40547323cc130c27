"""All pages fit a phone, and what they say can be read, in light and in dark."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from browser.chromium import opened, served
from browser.test_viewer import a_model, a_view
from browser.viewing import write_page
from cli.commands import run_json
from finetune import tiny

from fragprune_plugins.workbench.commands.options import EngineOptions
from fragprune_plugins.workbench.demo import work as demo_page

pytestmark = [
    pytest.mark.browser,
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.timeout(900),  # the site runs the tutorial: a minute, many on a busy machine
]

ROOT = Path(__file__).parents[2]
PHONE = {"width": 390, "height": 844}
READABLE = 4.5
"""The least contrast that WCAG 2 asks of text; of large text it is 3."""

PAGES = {
    "demo": "demo/index.html",
    "report": "out/report.html",
    "audit": "audit/audit.html",
    "viewer": "viewer/index.html",
    "home": "site/index.html",
    "results": "site/results.html",
}
OURS = [name for name, path in PAGES.items() if not path.startswith("site")]
PLOTS = {"demo": ".plot img", "report": ".plot img", "results": "img[src*=default]"}


@pytest.fixture(scope="module")
def ours(tmp_path_factory):
    """The pages of a model that took four steps."""
    root = tmp_path_factory.mktemp("pages")
    data, model, _ = tiny.scene(root)
    pruned = root / "out" / "pruned.ply"
    words = ("--data", data, "--iters", 4, "--train", "opacity")
    run_json("finetune", model, "--out", pruned, *words)
    run_json("report", root / "out", "--data", data)
    run_json("audit", model, "--out", root / "audit", "--views", 3, "--resolution", 16)
    write_page(root / "viewer", [a_model()], a_view())
    shutil.copytree(pruned.parent, root / "demo")
    shutil.copytree(data, root / "demo" / "scene")
    demo_page.write_page(root / "demo", EngineOptions("cpu", "cpu"))
    return root


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The documentation, built."""
    root = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "-q", "-d", str(root / "site")]
    subprocess.run(build, cwd=ROOT, env=os.environ | {"NO_COLOR": "1"}, check=True)
    return root


@pytest.fixture
def shown(browser, request, name):
    """Opens the page of a test's name, with options of ``opened``."""
    root = request.getfixturevalue("ours" if name in OURS else "site")
    with served(root) as address:
        yield lambda **context: opened(browser, address + PAGES[name], **context)


@pytest.mark.parametrize("name", PAGES)
def test_a_phone_scrolls_no_page_sideways(shown, name):
    with shown(**PHONE, is_mobile=True, has_touch=True) as tab:
        tab.page.wait_for_timeout(500)
        wide = tab.run(
            """width => [document.documentElement.scrollWidth,
                [...document.querySelectorAll("body *")]
                    .filter(each => each.getBoundingClientRect().right > width + 1)
                    .map(each => each.tagName + "." + each.className).slice(0, 5)]""",
            PHONE["width"],
        )
        assert wide[0] <= PHONE["width"], wide[1]


def luminance(colours: np.ndarray) -> np.ndarray:
    """WCAG's relative luminance of (..., 3) sRGB levels of 255."""
    share = colours / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def contrast(one: float, other: float) -> float:
    low, high = sorted((one, other))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", PLOTS)
def test_plots_can_be_read(shown, name, scheme):
    """At their left edge there is nothing but words on a ground."""
    with shown(color_scheme=scheme) as tab:
        tab.page.locator(PLOTS[name]).first.scroll_into_view_if_needed()
        tab.page.wait_for_timeout(300)
        picture = tab.picture(f"{PLOTS[name]} >> nth=0")
        levels = luminance(picture[:, : picture.shape[1] // 14])
        words = np.quantile(levels, [0.005, 0.995])
        assert max(contrast(np.median(levels), each) for each in words) > READABLE


@pytest.mark.parametrize("name", ["demo", "report"])
def test_curves_stay_large_enough_for_their_letters(shown, name):
    """A phone scrolls them: at its width letters have six pixels."""
    with shown(**PHONE, is_mobile=True, has_touch=True) as tab:
        plot = tab.page.locator(PLOTS[name]).first
        plot.scroll_into_view_if_needed()
        assert plot.bounding_box()["width"] > 550


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", OURS)
def test_text_can_be_read(shown, name, scheme):
    """Text over pictures has a ground of its own."""
    with shown(color_scheme=scheme) as tab:
        tab.page.wait_for_timeout(500)
        faint = tab.run(FAINT, READABLE)
        assert faint == []


FAINT = """(least) => {
    const colour = text => {
        const [r, g, b, a = 1] = text.match(/[\\d.]+/g).map(Number);
        return [r, g, b, a];
    };
    const over = (top, below) => [0, 1, 2].map(i => top[i] * top[3] + below[i] * (1 - top[3]));
    const light = rgb => rgb.slice(0, 3)
        .map(each => each / 255)
        .map(each => each <= 0.04045 ? each / 12.92 : ((each + 0.055) / 1.055) ** 2.4)
        .reduce((sum, each, i) => sum + each * [0.2126, 0.7152, 0.0722][i], 0);
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    const ground = element => {
        const layers = [];
        for (let at = element; at; at = at.parentElement)
            layers.unshift(colour(getComputedStyle(at).backgroundColor));
        const canvas = dark ? [18, 18, 18] : [255, 255, 255];
        return layers.reduce((below, top) => over(top, below), canvas);
    };
    const found = new Map();
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    const seen = { opacityProperty: true, visibilityProperty: true };
    while (walker.nextNode()) {
        const element = walker.currentNode.parentElement;
        const words = walker.currentNode.textContent.trim();
        if (!words || ["SCRIPT", "STYLE"].includes(element.tagName)) continue;
        if (!element.checkVisibility(seen)) continue;
        const { color, fontSize } = getComputedStyle(element);
        const below = ground(element), text = over(colour(color), below);
        const [low, high] = [light(below), light(text)].sort((a, b) => a - b);
        const ratio = (high + 0.05) / (low + 0.05);
        if (ratio < (parseFloat(fontSize) >= 24 ? 3 : least))
            found.set(`${element.tagName} ${element.className}`, `${ratio.toFixed(2)} ${words}`);
    }
    return [...found].map(each => each.join(": "));
}"""
