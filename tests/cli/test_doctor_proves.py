"""``fragprune doctor --prove``: who draws otherwise is named, and never timed."""

import json
import sys
from dataclasses import replace
from math import isnan

import pytest
import torch
from cli.commands import succeeds

from fragprune_graphdeco import GraphdecoDialect, stand_ins
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.cpu.engine import CpuEngine
from fragprune_plugins.engines.cuda import comparison
from fragprune_plugins.errors import EngineError
from fragprune_plugins.workbench.doctor import peers, prove

PACKAGE = "diff_gaussian_rasterization"
EMULATION = {"compiler": "g++", "not_proved": None, "differences": [], "scenes": []}


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(prove, "SCENES", {"cpu": ((300, (48, 32)),)})
    monkeypatch.setattr(prove, "_emulation", lambda: EMULATION)  # gpu/test_proof.py has it


class Wrong(CpuEngine):
    """Draws with one thing changed."""

    def __init__(self, change):
        super().__init__()
        self._change = change

    def rasterize(self, inputs, thresholds):
        return self._change(super().rasterize, inputs, thresholds)


def half_a_gradient(draw, inputs, cut):
    scales = inputs.splats.scales
    halved = scales.detach() / 2 + scales / 2
    return draw(replace(inputs, splats=replace(inputs.splats, scales=halved)), cut)


def brighter(draw, inputs, cut):
    outputs = draw(inputs, cut)
    return replace(outputs, image=outputs.image * 1.001)


CHANGES = {
    "brighter": brighter,
    "thresholds ignored": lambda draw, inputs, cut: draw(inputs, cut * 0 + 1e-6),
    "wider": lambda draw, inputs, cut: draw(replace(inputs, dilation=0.31), cut),
    "half a gradient": half_a_gradient,
}


def test_every_engine_here_agrees_and_is_timed():
    result = succeeds("doctor", "--prove", "--json")
    proof = json.loads(result.stdout, parse_constant=pytest.fail)
    assert proof["format"] == "fragprune-proof 2"
    builds = [f"cpu ({build})" for build in binding.usable_builds()]
    assert [check["name"] for check in proof["checks"]] == builds
    assert all(check["differences"] == [] for check in proof["checks"])
    assert len(proof["times"]) == 4 * len(builds)
    assert {*builds} == {row["engine"] for row in proof["times"]}
    assert proof["hashes"].keys() >= {"kernels", "scene", *binding.usable_builds()}


@pytest.mark.parametrize("change", CHANGES)
def test_who_draws_otherwise_is_named_and_not_timed(monkeypatch, change):
    engines = {"wrong": Wrong(CHANGES[change]), "right": CpuEngine()}
    monkeypatch.setattr(prove, "_ours", lambda kind: engines)
    report = prove.prove(repeats=2)
    assert report.exit_code == 1
    assert [bool(check["differences"]) for check in report.data["checks"]] == [True, False]
    assert {row["engine"] for row in report.data["times"]} == {"right"}
    assert "wrong: cutoffs, " in report.text


def test_what_nobody_held_is_said_and_is_no_success(monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(prove, "SCENES", {"cpu": ()})
    monkeypatch.setattr(prove, "find_compiler", lambda: None)
    report = prove.prove()
    assert report.exit_code == 1
    assert report.data["emulation"]["not_proved"]
    assert "cuda kernels, emulated: NOT PROVED, no C++17 compiler" in report.text


def test_without_an_engine_of_ours_nothing_is_proved(monkeypatch):
    monkeypatch.setattr(binding, "usable_builds", list)
    monkeypatch.setattr(binding, "available", lambda: False)
    monkeypatch.setattr(binding, "chosen", lambda: "not built")
    report = prove.prove()
    assert report.exit_code == 1
    assert "cpu: left out, not built" in report.text


@pytest.fixture
def host(monkeypatch):
    """A package of the hosts' rasterizer that draws with our engine; a factor on its picture."""
    factor = [1.0]
    fields = (
        *("image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier"),
        *("viewmatrix", "projmatrix", "sh_degree", "campos", "prefiltered", "debug"),
    )
    dialect = GraphdecoDialect(PACKAGE, fields, 2)

    def draw(call):
        outputs = CpuEngine().rasterize(dialect.unpack(call), None)
        return outputs.image * factor[0], outputs.radii

    module = stand_ins.rasterizer(PACKAGE, fields, draw)
    monkeypatch.setitem(sys.modules, PACKAGE, module)
    return factor, module


def test_a_hosts_own_rasterizer_that_agrees_is_timed_in_turns(host):
    engines = {"ours": CpuEngine(), "host": peers.peer(PACKAGE)}
    assert prove._check("host", engines["host"], "cpu")["differences"] == []
    rows = list(prove._times(engines, "cpu", 2))
    assert [row["engine"] for row in rows if row["round"] == "peers"] == ["ours", "host"] * 2
    assert all(isnan(row["fragments_per_pixel"]) for row in rows if row["engine"] == "host")
    assert all(row["difference"] < 1e-6 for row in rows if row["round"] == "peers")


def test_a_hosts_rasterizer_that_draws_otherwise_is_named(host):
    host[0][0] = 1.05
    (picture, *gradients) = prove._check("host", peers.peer(PACKAGE), "cpu")["differences"]
    assert "another picture" in picture
    assert any("gradient of sh" in line for line in gradients)


def test_another_rasterizer_by_the_same_name_is_refused(host):
    fields = ("image_height", "kernel_size")
    module = stand_ins.rasterizer(PACKAGE, fields, None)
    host[1].GaussianRasterizationSettings = module.GaussianRasterizationSettings
    (said,) = prove._check("host", peers.peer(PACKAGE), "cpu")["differences"]
    assert "kernel_size" in said


def test_a_peer_takes_no_thresholds(host):
    inputs, cut = comparison.scene(20, (16, 16), 2.0)
    with pytest.raises(EngineError, match="Leave them out"):
        peers.peer(PACKAGE).rasterize(inputs, torch.as_tensor(cut))
