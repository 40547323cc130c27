"""``torchrun -m fragprune_plugins finetune``: one writes and prints, and they end together."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from cli.commands import fails, run_json
from finetune.several import at_step, command, needs_processes

from fragprune_plugins.errors import DatasetError
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.workbench.scenes.dataset import Photograph


def names(folder):
    return {each.name for each in folder.iterdir()}


def test_the_first_process_writes_and_reports_and_the_others_say_nothing(tuning, tmp_path):
    one, two, log = tmp_path / "one.ply", tmp_path / "two.ply", tmp_path / "log.csv"
    whole = run_json(*tuning(one, "--views-per-step", 2))
    first, second = command(2, *tuning(two, "--json", "--log", f"csv:{log}"))
    assert (first.code, second.code) == (0, 0)
    code, out, err = first.left
    report = json.loads(out)
    assert code == 0
    assert "fine-tuning: 100%" in err
    assert second.left == (0, "", "")
    assert one.read_bytes() == two.read_bytes()
    assert report["settings"] == whole["settings"]
    assert report["settings"]["views_per_step"] == 2
    assert report["after"]["psnr"] == whole["after"]["psnr"]
    with open(log) as file:
        assert [row["step"] for row in csv.DictReader(file)] == [str(n + 1) for n in range(20)]
    again, other = command(2, *tuning(two))
    assert "nothing was done" in again.left[1]
    assert other.left == (0, "", "")


@pytest.mark.parametrize(("size", "killed"), [(2, 0), (3, 1)])
def test_a_kill_of_one_ends_all_with_one_error_and_keeps_saves(tuning, tmp_path, size, killed):
    out = tmp_path / "out.ply"
    run_json(*tuning(out, "--iters", 3))
    before, files = out.read_bytes(), names(tmp_path)

    def prepare(rank):
        if rank == killed:
            at_step(7, lambda: os.kill(os.getpid(), signal.SIGKILL))

    ended = command(size, *tuning(out, "--again"), prepare=prepare)
    assert ended[killed].code == -signal.SIGKILL
    left = [each.left for rank, each in enumerate(ended) if rank != killed]
    assert [code for code, _, _ in left] == [1] * (size - 1)
    said = "".join(out + err for _, out, err in left)
    assert said.count("[ranks]") == 1
    assert said.count("another process ended") == 1
    assert out.read_bytes() == before
    locks = {name for name in names(tmp_path) - files if name.endswith("-run")}
    assert names(tmp_path) - files == (locks if killed == 0 else set())


def test_a_process_that_raises_takes_all_down_with_its_own_words(tuning, out, tmp_path):
    torn = DatasetError("view", "a torn page", "a photograph", "Scan it again.")

    def unreadable(rank):
        if rank == 1:
            at_step(5, lambda: setattr(Photograph, "image", property(Mock(side_effect=torn))))

    files = names(tmp_path)
    ended = command(2, *tuning(out, "--json"), prepare=unreadable)
    (first, silent, _), (second, said, _) = (each.left for each in ended)
    assert (first, second) == (1, 1)
    assert json.loads(silent + said)["error"]["found"] == "a torn page"
    assert names(tmp_path) == files


@pytest.mark.parametrize(
    ("number", "more"), [(signal.SIGINT, ()), (signal.SIGTERM, ("--shard-gaussians",))]
)
def test_a_signal_to_one_ends_all_after_the_same_step(tuning, tmp_path, number, more):
    """Then one process goes on; shards go on as shards."""
    whole, out = tmp_path / "whole.ply", tmp_path / "out.ply"

    def again(place):
        if not more:
            return run_json(*tuning(place, "--views-per-step", 2))
        return json.loads(command(2, *tuning(place, *more, "--json"))[0].left[1])

    def prepare(rank):
        if rank == 1:
            at_step(6, lambda: signal.raise_signal(number))

    again(whole)
    ended = command(2, *tuning(out, *more), prepare=prepare)
    (first, text, _), second = (each.left for each in ended)
    assert (first, second) == (128 + number, (0, "", ""))
    assert "7 of 20 iterations" in text
    assert len(read_ply(out)) == len(read_ply(whole))
    assert again(out)["resumed_at"] == 7
    assert out.read_bytes() == whole.read_bytes()


@pytest.mark.parametrize(
    ("more", "found"),
    [
        (("--views-per-step", 3), "3 for 2 processes"),
        (("--shard-gaussians", "--portable"), "--shard-gaussians with --portable"),
    ],
)
def test_what_is_refused_is_said_once(tuning, tmp_path, more, found):
    ended = command(2, *tuning(tmp_path / "out.ply", *more))
    assert [each.left[0] for each in ended] == [2, 2]
    said = "".join(out + err for _, out, err in (each.left for each in ended))
    assert said.count(found) == 1


@pytest.mark.parametrize("more", [("--max-drop", 0.5, "--keep", 0.9), ("--self",)])
def test_what_goes_before_and_around_learning_is_the_same_in_both(tuning, tmp_path, more):
    one, two = (tmp_path / name for name in ("one.ply", "two.ply"))
    run_json(*tuning(one, *more, "--iters", 3, "--views-per-step", 2))
    first, second = command(2, *tuning(two, *more, "--iters", 3, "--json"))
    assert (first.left[0], second.left) == (0, (0, "", ""))
    assert one.read_bytes() == two.read_bytes()


def test_shards_write_and_report_as_one_process_does(tuning, out):
    """What they learn is test_shards'."""
    words = tuning(out, "--train", "opacity", "--shard-gaussians", "--iters", 2)
    first, second = command(2, *words, "--json")
    code, printed, err = first.left
    assert (code, second.left) == (0, (0, "", "")), err
    report = json.loads(printed)
    assert report["shards"] == 2
    assert report["after"]["gaussians"] == len(read_ply(out)) == 60
    text = command(2, *words, "--again")[0].left[1]
    assert "2 processes held a part of the Gaussians each" in text


@needs_processes
def test_no_launcher_no_rendezvous(tuning, tmp_path, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    for name in ("RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    fails(*tuning(tmp_path / "out.ply"), says="Start them with torchrun", code=1)


OFTEN = """
from fragprune_plugins.workbench.commands import main
from fragprune_plugins.workbench.finetune import resuming

resuming.EVERY = 0.0
main()
"""
LAUNCHER = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"]


@pytest.mark.slow
def test_torchrun_itself_ends_when_one_is_killed_and_goes_on(tuning, tmp_path):
    """The same, with the real launcher, whose exit code is 1 then."""
    out, whole = tmp_path / "out.ply", tmp_path / "whole.ply"
    script = tmp_path / "often.py"
    script.write_text(OFTEN)
    line = [*LAUNCHER, str(script), *map(str, tuning(out, "--iters", 300))]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run_:
        children = Path(f"/proc/{run_.pid}/task/{run_.pid}/children")
        while not out.with_suffix(".fragprune-unfinished").exists():
            assert run_.poll() is None, run_.stderr.read()
            time.sleep(0.1)
        last = max(map(int, children.read_text().split()))
        os.kill(last, signal.SIGKILL)
        said, error = run_.communicate(timeout=60)
    assert run_.returncode == 1
    assert said == ""
    assert error.count("[ranks]") <= 1  # none where the launcher ends the other one sooner
    assert f"exitcode  : -9 (pid: {last})" in error
    assert not out.exists()
    done = subprocess.run(line, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert "resuming at step" in done.stderr
    assert done.stdout.count("PSNR, dB") == 1
    run_json(*tuning(whole, "--iters", 300, "--views-per-step", 2))
    assert out.read_bytes() == whole.read_bytes()
    left = {name for name in names(tmp_path) if "out" in name or name[0] == "."}
    assert left == {"out.ply", "out.fragprune.json"}


@pytest.mark.gpu
@pytest.mark.parametrize("more", [(), ("--shard-gaussians",)])
def test_two_gpus_learn_what_one_does_with_two_views_a_step(tuning, tmp_path, more):
    """Replicas are compared at the end; sums on a GPU have no fixed order, so figures are near."""
    if torch.cuda.device_count() < 2:
        pytest.skip("needs two GPUs")
    one, two = tmp_path / "one.ply", tmp_path / "two.ply"
    whole = run_json(*tuning(one, "--views-per-step", 2, "--device", "cuda:0"))
    words = tuning(two, "--device", "cuda", "--json", *more)
    line = [*LAUNCHER, "-m", "fragprune_plugins", *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["after"]["psnr"] == pytest.approx(whole["after"]["psnr"], abs=0.05)
