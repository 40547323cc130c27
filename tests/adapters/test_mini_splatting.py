"""Mini-Splatting: scores, new points, simplification, compression, on a miniature of the host."""

import logging
import sys
from importlib import import_module

import numpy as np
import pytest
import torch
from miniatures import runs
from miniatures.mini_splatting import MiniSplattingHost
from miniatures.runs import OFF, OPTIONS, miniature
from miniatures.vanilla_3dgs import HOST, joint, label, running

from fragprune_mini_splatting import MiniSplatting
from fragprune_plugins.adapting import HostRepo
from fragprune_plugins.errors import AlignmentError, SeamError, UnknownHostError
from fragprune_plugins.files import sidecar
from fragprune_plugins.hosts.choosing import choose, locate
from fragprune_plugins.injection.launch import run
from fragprune_plugins.plugins.loading import load_plugins

mini, of = miniature(MiniSplattingHost, MiniSplatting)


def test_a_scripts_folder_lies_in_its_host(mini):
    adapters = load_plugins().adapters
    repo, adapter = locate(HostRepo(mini / "ms"), adapters)
    assert (repo.root, adapter.name) == (mini.resolve(), "mini-splatting")
    assert choose(HostRepo(HOST), adapters).name == "vanilla-3dgs"
    with pytest.raises(UnknownHostError, match="no adapter fits"):
        locate(HostRepo(mini / "nowhere" / "deep"), adapters)


@pytest.mark.parametrize("engine", ["reference", "cpu"])
def test_scores_are_those_of_the_truncated_picture(mini, engine):
    """Weights add up to the picture of white Gaussians; each drawn pixel is won once."""
    scores = {}
    with joint(**of(mini, engine=engine)) as host:
        model, camera = host.model(30), host.camera()
        render = import_module("gaussian_renderer")
        pipe, black = host.driver.pipe(), torch.zeros(3)
        white = torch.ones(30, 3)
        for threshold in (None, -2.0):
            if threshold is not None:
                label(host, model)
                with torch.no_grad():
                    host.store(model).logits.fill_(threshold)
            with torch.no_grad():
                package = render.render_imp(camera, model, pipe, black, override_color=white)
                plain = render.render(camera, model, pipe, black, override_color=white)
            image, wins = package["render"], package["area_max"]
            assert torch.equal(image, plain["render"])
            torch.testing.assert_close(package["accum_weights"].sum(), image[0].sum())
            assert wins.sum() == (image[0] > 0).sum()
            assert (package["area_proj"].dtype, wins.dtype) == (torch.int32, torch.float32)
            assert ((wins > 0) <= (package["area_proj"] > 0)).all()
            scores[threshold] = package
    whole, truncated = scores[None], scores[-2.0]
    assert (truncated["area_proj"] <= whole["area_proj"]).all()
    assert truncated["area_proj"].sum() < 0.8 * whole["area_proj"].sum()
    assert torch.equal(truncated["radii"], whole["radii"])  # the host's rule, whatever is drawn


FLAGS = [
    *("--densify_until_iter", 10, "--simp_iteration1", 10, "--simp_iteration2", 13),
    *("--depth_interval", 6, "--num_depth", 240, "--imp_metric", "indoor"),
]


def command(mini, scene, out, iterations, *more):
    return runs.command(mini / "ms/train.py", scene, out, iterations, *FLAGS, *more)


def test_the_metric_without_its_weights_is_said_once(mini, photographs, tmp_path, caplog):
    with caplog.at_level(logging.WARNING, logger="fragprune"):
        more = ["--test_iterations", 2, 3]
        run(command(mini, photographs, tmp_path, 4, *more), OFF)
    said = [record for record in caplog.records if "lpipsPyTorch:lpips" in record.getMessage()]
    assert len(said) == 1
    assert "no way there" in said[0].getMessage()


def test_another_package_of_the_hosts_name_is_refused(mini, photographs, tmp_path, monkeypatch):
    """The host appends itself to the path: whatever lies before it would be imported instead."""
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene/__init__.py").write_text("class Scene:\n    def __init__(self): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SeamError, match="a module of the same name"):
        run(command(mini, photographs, tmp_path / "out", 16), OPTIONS)
    sys.modules.pop("scene", None)


PARTS = ("_xyz", "_features_dc", "_features_rest", "_scaling", "_rotation", "_opacity")
ROWS = [9, 4, 17, 2]
"""What ms_c keeps: one Gaussian for each voxel, in an order of its own."""


@pytest.fixture
def compressed(mini, tmp_path):
    """The file that ms_c writes, and the thresholds of its Gaussians."""
    file = tmp_path / "compressed_gs.npz"
    with joint(**of(mini)) as host:
        model = host.model(20)
        label(host, model)
        np.savez_compressed(file, *(getattr(model, part).detach()[ROWS].numpy() for part in PARTS))
        return file, host.store(model).logits[ROWS].detach()


def test_compression_takes_each_gaussians_threshold_along(compressed):
    file, logits = compressed
    packed, info = sidecar.load(file)
    assert torch.equal(packed.logits, logits)
    assert (info.adapter, info.rows) == ("mini-splatting", len(ROWS))


def test_what_is_decompressed_is_drawn_with_its_thresholds(mini, compressed):
    file, logits = compressed
    with running(**of(mini), learn=False) as host:
        model, data = host.model(5, setup=False), np.load(file)
        for index, part in enumerate(PARTS):
            setattr(model, part, torch.tensor(data[f"arr_{index}"]))
        truncated = host.render(host.camera(), model)["render"]
        assert torch.equal(host.store(model).logits, logits)
        with host.paused():
            assert not torch.equal(host.render(host.camera(), model)["render"], truncated)


def test_an_unpacked_file_and_another_model_are_not_paired(mini, compressed):
    with joint(**of(mini)) as host:
        np.load(compressed[0])["arr_0"]
        with pytest.raises(AlignmentError, match="differ from the unpacked file's"):
            host.render(host.camera(), host.model(9, setup=False))
