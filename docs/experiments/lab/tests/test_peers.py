"""Peers: found by import, timed in a process of their own, and believed only with our picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lab import peers

from fragprune_plugins.engines import create_engine
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.bench.scene import make_scene, make_view

PIPELINE = '''
import numpy as np


def pick_variant(device):
    return "for " + device


class Pipeline:
    """Answers the picture stored beside it, if it is called as gausscam is."""

    def __init__(self, scene, device, variant):
        assert variant == "for Fake GPU", variant
        assert scene["xyz"].shape == scene["sh"].shape == (300, 3)
        assert scene["xyz"].dtype == scene["cam_pos"].dtype == np.float32
        assert np.allclose(np.linalg.norm(scene["rot"], axis=1), 1, atol=1e-5)
        assert np.linalg.det(scene["cam_xmat"][0]) > 0.999
        self.size = int(scene["H"]), int(scene["W"])
        print("noise on stdout")

    def render_frame(self):
        {body}
        return np.load({picture!r}), None

    def unpack(self, rgb, depth):
        assert rgb.shape == (*self.size, 3)
        return rgb[None], depth
'''
WGPU = """
class gpu:
    @staticmethod
    def enumerate_adapters_sync():
        class Adapter:
            info = {"backend_type": "Vulkan", "device": "Fake GPU"}
        return [Adapter]
"""


@pytest.fixture
def scene() -> tuple[Any, Any, torch.Tensor]:
    splats = make_scene(300).splats()
    splats = replace(splats, sh=splats.sh[:, :1].contiguous(), sh_degree=0)
    view = make_view(40, 30)
    return splats, view, create_engine("auto").rasterize(RasterInputs(view, splats), None).image


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Install a peer of gausscam's names that draws a stored picture."""

    def install(picture: torch.Tensor, body: str = "") -> None:
        import numpy as np

        file = tmp_path / "picture.npy"
        np.save(file, (picture.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy())
        package = tmp_path / "gausscam" / "backends"
        package.mkdir(parents=True)
        (package / "webgpu.py").write_text(
            PIPELINE.replace("{body}", body).replace("{picture!r}", repr(str(file)))
        )
        (tmp_path / "wgpu.py").write_text(WGPU)
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))
        monkeypatch.syspath_prepend(tmp_path)

    return install


def test_absent_peers_are_not_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "PEERS", {"nobody": (("no_such_module",), None)})
    assert peers.installed() == []


def test_a_peer_with_our_picture_is_timed(scene, fake) -> None:
    splats, view, truth = scene
    fake(truth)
    assert "gausscam" in peers.installed()
    row = peers.time_peer("gausscam", splats, view, truth, repeats=4)
    assert row["failed"] is None
    assert row["device"] == "Fake GPU"
    assert (row["width"], row["height"], row["gaussians"]) == (40, 30, 300)
    assert 0 < row["ms_min"] <= row["ms_median"]
    assert row["psnr"] > 50


def test_another_picture_has_no_times(scene, fake) -> None:
    splats, view, truth = scene
    fake(truth.flip(2))
    row = peers.time_peer("gausscam", splats, view, truth, repeats=2)
    assert "another picture" in row["failed"]
    assert row["psnr"] < peers.SAME_PICTURE_DB
    assert row["ms_median"] is None


def test_a_deadlock_is_an_answer(scene, fake) -> None:
    splats, view, truth = scene
    fake(truth, body="import time; time.sleep(60)")
    row = peers.time_peer("gausscam", splats, view, truth, repeats=2, limit=3)
    assert row["failed"] == "no end after 3 s"


def test_a_crash_is_an_answer(scene, fake) -> None:
    splats, view, truth = scene
    fake(truth, body="raise RuntimeError('lost the device')")
    row = peers.time_peer("gausscam", splats, view, truth, repeats=2)
    assert row["failed"] == "exit code 1: RuntimeError: lost the device"
