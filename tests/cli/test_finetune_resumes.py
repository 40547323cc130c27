"""The same ``fragprune finetune`` again, after a kill or after its end."""

import json
import os
import signal
from unittest.mock import Mock

import pytest
from cli.commands import fails, run, run_json, succeeds
from finetune import tiny
from finetune.several import at_step, ended

from fragprune_plugins.errors import OutputError
from fragprune_plugins.files.atomic import locked
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.finetune import resuming


def killed(step, *arguments):
    """Run the command in a process of its own, and kill it with -9 in the midst of a step."""

    def die():
        resuming.EVERY = 0.0
        at_step(step, lambda: signal.raise_signal(signal.SIGKILL))
        run(*arguments)

    assert ended(die) == -signal.SIGKILL


def test_killed_twice_the_same_command_ends_with_the_same_files(tuning, tmp_path):
    whole, out = tmp_path / "whole.ply", tmp_path / "out.ply"
    succeeds(*tuning(whole))
    arguments = tuning(out)
    killed(7, *arguments)
    killed(19, *arguments)
    assert not out.exists()
    result = succeeds(*arguments, "--json")
    assert "resuming at step" in result.stderr
    report = json.loads(result.stdout)
    assert report["resumed_at"] == 19
    assert report["iterations"] == 20
    assert out.read_bytes() == whole.read_bytes()
    left = {each.name for each in tmp_path.iterdir() if "out" in each.name or each.name[0] == "."}
    assert left == {"out.ply", "out.fragprune.json"}


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_is_gone_on_from_with_the_same_gaussians(tuning, tmp_path, monkeypatch):
    whole, out = tmp_path / "whole.ply", tmp_path / "out.ply"
    succeeds(*tuning(whole, "--keep", 0.5))
    tiny.at_loss(monkeypatch, 7, lambda: signal.raise_signal(signal.SIGINT))
    result = run(*tuning(out, "--keep", 0.5))
    assert result.exit_code == 130
    assert "The same command goes on from there." in result.stdout
    assert run_json(*tuning(out, "--keep", 0.5))["resumed_at"] == 7
    assert out.read_bytes() == whole.read_bytes()
    assert not resuming.path_beside(out).exists()


def test_a_finished_command_says_so_and_does_nothing(tuning, out, monkeypatch):
    first = run_json(*tuning(out, "--iters", 2))
    with monkeypatch.context() as patch:
        patch.setattr("fragprune_plugins.workbench.finetune.api.finetune", None)  # cannot be called
        again = run_json(*tuning(out, "--iters", 2))
        assert again == first | {"already_finished": True}
        said = succeeds(*tuning(out, "--iters", 2)).stdout
    assert "PSNR, dB" in said  # the whole report
    assert "was finished before: nothing was done. --again" in said
    assert run_json(*tuning(out, "--iters", 2, "--again"))["already_finished"] is False


def test_a_record_without_space_takes_no_figures_and_no_checkpoint(tuning, out, monkeypatch):
    monkeypatch.setattr(resuming, "EVERY", 0.0)
    with monkeypatch.context() as patch:
        full = OutputError(str(out), "no space", "a place", "Free some.")
        patch.setattr(records, "replacing", Mock(side_effect=full))
        result = run(*tuning(out, "--iters", 3), "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["after"]["psnr"] > 0
    assert f"{out} is written, its record is not: [output]" in result.stderr
    assert run_json(*tuning(out, "--iters", 3))["resumed_at"] == 3
    assert records.beside(out)


@pytest.mark.parametrize(
    "change", ["other options", "another model", "another photograph", "rewritten", "no record"]
)
def test_what_is_not_the_same_is_not_finished(tuning, data, path, out, change):
    more = []
    run_json(*tuning(out, "--iters", 2))
    if change == "other options":
        more = ["--pressure", 1e-3]
    elif change == "another model":
        path.write_bytes(path.read_bytes()[:-4] + b"\0\0\0\0")
    elif change == "another photograph":
        first, second, *_ = sorted((data / "images").iterdir())
        second.write_bytes(first.read_bytes())
    elif change == "rewritten":
        record = out.with_suffix(".fragprune.json").stat()
        out.write_bytes(out.read_bytes() + b"\0")
        os.utime(out, ns=(record.st_atime_ns, record.st_mtime_ns + 1))
    else:
        out.with_suffix(".fragprune.json").unlink()
    assert run_json(*tuning(out, "--iters", 2, *more))["already_finished"] is False


def test_another_command_is_refused_while_one_is_unfinished(tuning, out):
    killed(9, *tuning(out))
    other = tuning(out, "--pressure", 1e-3)
    fails(*other, says=("[checkpoint]", "with other goal"), code=1)
    assert run_json(*other, "--again")["resumed_at"] == 0


def test_two_at_once_are_refused(tuning, out):
    with locked(out, wait=0, what="run"):
        fails(*tuning(out), says="another process", code=1)
    succeeds(*tuning(out))
