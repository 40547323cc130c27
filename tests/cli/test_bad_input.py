"""Each bad input has one message, exit code 1, and touches nothing that was there."""

import json
import os
from itertools import combinations
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from cli.commands import fails, run, run_error
from finetune import tiny

from fragprune_plugins.files import sidecar
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.workbench.models.formats.ply import write_ply


@pytest.fixture
def out(tmp_path):
    out = tmp_path / "out.ply"
    out.write_bytes(b"precious")
    sidecar.path_beside(out).write_bytes(b"dear")
    return out


def refused(arguments, code, words):
    """Run twice: as text, as JSON; the same error, no traceback."""
    result = run(*arguments)
    assert result.exit_code == 1, result.output
    assert result.stdout == ""
    message = result.stderr.strip()
    assert message.startswith(f"[{code}] ")
    assert words in message
    assert "\n" not in message
    error = run_error(*arguments, "--json")
    assert error["code"] == code
    assert all(error[part] for part in ("where", "found", "expected", "remedy"))


def untouched(out):
    return out.read_bytes() == b"precious" and sidecar.path_beside(out).read_bytes() == b"dear"


def stale(path):
    sidecar.save(path, ThresholdStore(60))
    path.write_bytes(path.read_bytes()[:-1] + b"\x01")
    return path


def cut_off(path):
    path.write_bytes(path.read_bytes()[:-50])
    return path


@pytest.mark.parametrize(
    ("spoiled", "code", "words"),
    [
        (cut_off, "model-file", "not readable as PLY"),
        (lambda path: path.rename(path.with_name("chkpnt30.pth")), "model-file", "(4D models)"),
        (lambda path: path.rename(path.with_name("ckpt_29.pt")), "model-file", "(4D models)"),
        (lambda path: "x" * 300, "model-file", "cannot be opened (File name too long)"),
        (stale, "sidecar", "thresholds of another model"),
    ],
)
@pytest.mark.parametrize("command", ["finetune", "export"])
def test_refused(data, path, out, command, spoiled, code, words):
    """What is wrong with files is said by their readers, and tested with them."""
    more = ("--data", data) if command == "finetune" else ()
    refused((command, spoiled(path), "--out", out, *more), code, words)
    assert untouched(out)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--data", "nowhere"), ("dataset", "no such folder")),
        ((), ("dataset", "view00.png: not readable")),
        (("--resolution", 4), ("input", "8x8 pixels")),
        (("--out", "{out}/below-a-file.ply"), ("output", "cannot be written")),
        (("--out", "folder.ply"), ("output", "a folder")),
        (("--out", "pipe.ply"), ("output", "a pipe")),
    ],
)
def test_what_cannot_end_well_is_refused_before_learning(
    data, path, out, tmp_path, monkeypatch, more, said
):
    monkeypatch.setattr("fragprune_plugins.workbench.finetune.api.finetune", None)  # never called
    monkeypatch.chdir(tmp_path)
    Path("folder.ply").mkdir()
    os.mkfifo("pipe.ply")
    if not more:
        held_out = data / "images" / "view00.png"
        held_out.write_bytes(held_out.read_bytes()[:-100])
    more = [str(word).format(out=out) for word in more]
    refused(("finetune", path, "--data", data, "--out", out, *more), *said)
    assert untouched(out)
    assert Path("pipe.ply").is_fifo()


@pytest.mark.parametrize(
    ("command", "more"), [("finetune", ["--data"]), ("export", []), ("export", ["returned"])]
)
def test_the_model_itself_is_no_output(data, path, tmp_path, command, more):
    write_ply(path, tiny.cut(tiny.random_model(8), 0.3))
    write_ply(tmp_path / "edited.ply", tiny.random_model(8))
    before = path.read_bytes()
    given = {"--data": (path, "--data", data), "returned": (tmp_path / "edited.ply", path)}
    for out in (path, path.with_suffix(".PLY")):  # one sidecar for both
        words = given[more[0]] if more else (path,)
        fails(command, *words, "--out", out, says="the model's name")
    assert path.read_bytes() == before


FINETUNE = "finetune FILE --out out.ply"
GOALS = (
    *("--control", "--portable", "--pressure 1e-4"),
    *("--target-speedup 2", "--target-time 2", "--max-drop 0.1"),
)
OUT_OF_RANGE = {
    "--iters": [0],
    "--pressure": [5],
    "--target-speedup": [1],
    "--target-time": [21],
    "--stop": [3],
    "--dropout": [0.95],
    "--max-drop": [-1, 11, "much"],
    "--keep": [0, 1.5, "x", "nan"],
    "--log": ["csv", "csv:", "paper:x", ":x", "bar:3"],
}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("run --quik -- python train.py", "--quick"),  # not the host's command
        ("dem", "Did you mean demo?"),
        ("finetun", "Did you mean finetune?"),
        ("bridge babylon", "playcanvas or spark"),
        ("run --config no.toml -- python train.py", "no such file"),
        ("run --target-time 1.5 -- train.py", "--target-speedup"),
        ("run --max-drop 2 -- train.py", "No such option"),
        ("run --quick --iters 10 -- train.py", "--quick with --iters"),
        ("run --control --target-speedup 2 -- train.py", "--control with --target-speedup"),
        ("run --from-iter 5 -- train.py", "--stage finetune or joint"),
        ("run --from-iter 5 --stage off -- train.py", "--stage finetune or joint"),
        (f"{FINETUNE} --quick --iters 10", "--quick with --iters"),
        (f"{FINETUNE} --max-drop 0.1 --log csv:steps.csv", "--log with --max-drop"),
        (f"{FINETUNE} --self --max-drop 0.1", "--self with --max-drop"),
        (f"{FINETUNE} --self --control", "--self with --control"),
        (f"{FINETUNE} --self --keep auto", "--self with --keep auto"),
        (f"{FINETUNE} --self --data d --cameras c", "--data with --cameras"),
        (f"{FINETUNE} --cameras c", "--cameras without --self"),
        (FINETUNE, "Pass --data FOLDER with photographs"),
        ("compare FILE FILE", "no record"),
        (f"{FINETUNE} --data d --shard-gaussians", "torchrun"),
        *(
            (f"{FINETUNE} --shard-gaussians {other}", f"--shard-gaussians with {other.split()[0]}")
            for other in ("--self", "--portable", "--max-drop 0.1", "--keep 0.5")
        ),
        *(
            (
                f"{FINETUNE} {one} {other}",
                f"{one.split()[0]} with {other.split()[0]}; expected one goal",
            )
            for one, other in combinations(GOALS, 2)
            if (one, other) != ("--portable", "--pressure 1e-4")
        ),
        *(
            (f"{FINETUNE} {option} {value}", option)
            for option, values in OUT_OF_RANGE.items()
            for value in values
        ),
        ("finetune FILE --out pruned.txt", "'pruned.txt' does not end with .ply"),
        ("finetune FILE --out pruned", "'pruned' does not end with .ply"),
        ("export FILE --out pruned.obj", "'pruned.obj' does not end with .ply"),
        ("export FILE FILE --out o.ply --no-truncation", "PRUNED with --no-truncation"),
        ("report d --out page.pdf", "'page.pdf' does not end with .html"),
        ("view FILE --data x --cameras y", "--cameras with --data"),
        ("view FILE --port 70000", "--port"),
        ("audit FILE --out o --data x --orbit", "--data with --orbit"),
        ("audit FILE --out o --data x --inside", "--data with --inside"),
        ("render FILE --out o", "neither --cameras, --data nor --orbit"),
        *(
            (f"{command} . --out o.ply", "a folder without point_cloud/iteration_*/point_cloud.ply")
            for command in ("profile", "render", "finetune", "export")
        ),
        ("render FILE --orbit --out o.gif", "o.gif"),
        ("render FILE --out o --data x --shard-gaussians", "torchrun"),
        ("render FILE --out o --data x --cameras y", "--cameras with --data"),
        ("render FILE --out o --cameras y --views train", "--views without --data"),
        ("render FILE --out o --cameras y --images i", "--images without --data"),
        *(
            (f"render FILE --orbit --out a.mp4 --up {up}", "--up")
            for up in ("1,2", "a,b,c", "0,0,0", "nan,0,1", "inf,0,0")
        ),
        ("bench FILE --cameras c --gaussians 5", "--gaussians with MODEL"),
        ("bench --size 40", "--size"),
        ("bench --size 0x9", "--size"),
    ],
)
def test_words_that_make_no_sense_are_usage(words, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fails(*words.replace("FILE", __file__).split(), says=says)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "where", "found"),
    [
        (("finetune",), "cli finetune", "Missing argument 'MODEL'"),
        (("check", ".", "--fast"), "cli check", "No such option"),
        (("profile", "a.ply", "--data", "b", "--views", "some"), "cli profile", "'some' is not"),
        (("prune",), "cli", "No such command 'prune'"),
        (("run", "--iters", "many"), "cli run", "'many' is not"),
    ],
)
def test_usage_errors_are_said_as_text_and_as_json(words, where, found):
    result = run(*words)
    assert (result.exit_code, result.stdout) == (2, "")
    assert found in result.stderr
    command, *rest = words
    result = run(command, "--json", *rest)
    assert result.exit_code == 2
    error = json.loads(result.stdout)["error"]
    assert (error["code"], error["where"]) == ("usage", where)
    assert found in error["found"]
    assert result.stderr == ""


def test_the_hosts_own_json_flag_is_not_ours():
    result = run("run", "--iters", "many", "--", "train.py", "--json")
    assert (result.exit_code, result.stdout) == (2, "")


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (MemoryError(), "memory"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you"), "memory"),
        (OSError(36, "File name too long", "/a/b"), "path"),
        (ZeroDivisionError("a bug"), None),
    ],
)
def test_what_the_machine_refuses_is_stated_and_bugs_keep_their_traceback(
    data, path, monkeypatch, error, code
):
    measuring = "fragprune_plugins.workbench.figures.evaluate.measure_all"
    monkeypatch.setattr(measuring, Mock(side_effect=error))
    if code:
        refused(("profile", path, "--data", data), code, "")
        return
    with pytest.raises(ZeroDivisionError):
        run("profile", path, "--data", data)


def test_a_numpy_that_torch_cannot_use_is_named_before_anything_is_read(tmp_path, monkeypatch):
    """As torch before 2.3 beside NumPy 2."""
    unusable = Mock(side_effect=RuntimeError("Numpy is not available"))
    monkeypatch.setattr(torch.Tensor, "numpy", unusable)
    (tmp_path / "a.ply").write_text("not read")
    for words in (("audit", tmp_path / "a.ply", "--out", tmp_path / "out"), ("doctor",)):
        ended = run(*words)
        assert ended.exit_code == 1
        assert "for which it was not compiled; expected NumPy 1" in ended.output
        assert 'Run: pip install "numpy<2"' in ended.output
