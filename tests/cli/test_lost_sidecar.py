"""A model that was saved with thresholds beside it is not taken for one that has none."""

from __future__ import annotations

import json
import shutil

import pytest
from cli.commands import run, run_json
from finetune import tiny
from plyfile import PlyData

from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply, write_ply

COMMANDS = {
    "render": ("--data", "DATA", "--out", "pictures"),
    "profile": ("--data", "DATA"),
    "compare": ("MODEL", "--data", "DATA"),
    "finetune": ("--data", "DATA", "--out", "again.ply", "--iters", 2),
    "export": ("--out", "again.ply"),
}


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tuned")
    data, model, _ = tiny.scene(folder)
    out = folder / "pruned.ply"
    run_json("finetune", model, "--data", data, "--out", out, "--iters", 5)
    return data, out


def call(command, model, data, *more):
    places = {"DATA": data, "MODEL": model, "pictures": model.parent / "pictures"}
    places["again.ply"] = model.parent / "again.ply"
    return run(command, model, *(places.get(word, word) for word in COMMANDS[command]), *more)


@pytest.fixture
def lost(tuned, tmp_path):
    """The model under another name, its sidecar left behind."""
    data, pruned = tuned
    return data, shutil.copyfile(pruned, tmp_path / "renamed.ply")


@pytest.mark.parametrize("command", COMMANDS)
def test_without_its_sidecar_it_is_refused(lost, command):
    data, model = lost
    result = call(command, model, data, "--json")
    assert result.exit_code == 1
    error = json.loads(result.stdout)["error"]
    assert error["code"] == "sidecar"
    assert error["where"] == str(model.with_name("renamed.fragprune.safetensors"))
    assert "renamed.ply was saved with thresholds beside it" in error["found"]
    assert "--no-truncation" in error["remedy"]
    assert sorted(p.name for p in model.parent.rglob("*.ply")) == ["renamed.ply"]


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "export"])
def test_no_truncation_goes_without(lost, command):
    data, model = lost
    result = call(command, model, data, "--no-truncation")
    assert result.exit_code == 0, result.stderr


def test_with_its_sidecar_it_is_taken_under_any_name(lost, tuned):
    data, model = lost
    shutil.copyfile(sidecar.path_beside(tuned[1]), sidecar.path_beside(model))
    assert run_json("profile", model, "--data", data)["truncated"] is True


def test_a_column_needs_no_sidecar(tuned, tmp_path):
    data, pruned = tuned
    run_json("export", pruned, "--out", tmp_path / "exported.ply")
    report = run_json("profile", tmp_path / "exported.ply", "--data", data)
    assert report["truncated"] is True


def test_the_mark_is_a_comment_that_other_readers_pass_over(tuned):
    _, pruned = tuned
    lines = pruned.read_bytes().split(b"end_header\n")[0].decode("ascii").splitlines()
    # Some viewers take the third line for the number of Gaussians whatever it says.
    assert lines[2] == f"element vertex {len(read_ply(pruned))}"
    assert [line for line in lines if line.startswith("comment ")] == [
        "comment fragprune thresholds lie beside this file (.fragprune.safetensors)"
    ]
    vertex = PlyData.read(pruned)["vertex"]
    assert "trunc_threshold" not in [p.name for p in vertex.properties]
    assert sidecar.load(pruned)[1].rows == vertex.count


def test_a_model_without_thresholds_is_not_marked(tuned, tmp_path):
    data, _ = tuned
    out = tmp_path / "zero.ply"
    model = tmp_path / "model.ply"
    write_ply(model, tiny.random_model())
    run_json("finetune", model, "--data", data, "--out", out, "--iters", 2, "--control")
    sidecar.path_beside(out).unlink()
    assert run_json("profile", out, "--data", data)["truncated"] is False
