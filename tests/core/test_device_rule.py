"""One rule says where a command works; there need be no GPU to test it."""

import contextlib

import pytest
import torch
from cli.commands import run
from miniatures.skeletons import FLAGS, skeleton

from fragprune_plugins import engines
from fragprune_plugins.errors import UsageError
from fragprune_plugins.injection import launch, process
from fragprune_plugins.injection.launch import RunOptions


@pytest.fixture
def gpus(monkeypatch):
    """Pretend that torch sees so many, and that our cuda engine may be used on them or not."""

    def pretend(count: int, usable: bool = True) -> None:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
        why_not = None if usable else ("the cuda engine cannot be used on this GPU", "Do this.")
        monkeypatch.setattr(engines, "_why_not_cuda", lambda device: why_not)

    return pretend


@pytest.mark.parametrize(
    ("count", "usable", "wanted", "engine", "device"),
    [
        (0, True, "auto", "auto", "cpu"),
        (0, True, "auto", "cuda", "cpu"),  # whose engine then says what is missing
        (2, True, "auto", "auto", "cuda"),
        (2, True, "auto", "mine", "cuda"),
        (2, True, "auto", "cpu", "cpu"),
        (2, False, "auto", "auto", "cpu"),
        (2, False, "auto", "cuda", "cuda"),
        (2, True, "cpu", "auto", "cpu"),
        (2, False, "cuda", "auto", "cuda"),
        (2, True, "cuda:1", "auto", "cuda:1"),
    ],
)
def test_rule(gpus, count, usable, wanted, engine, device):
    gpus(count, usable)
    assert str(engines.device_for(wanted, engine)) == device


def test_a_gpu_that_is_not_used_is_spoken_of(gpus, caplog):
    gpus(1, usable=False)
    engines.device_for("auto")
    said = "working on the CPU: the cuda engine cannot be used on this GPU. Do this."
    assert said in caplog.text


@pytest.mark.parametrize(
    ("count", "wanted", "engine", "words"),
    [
        (0, "cuda", "auto", "no CUDA devices; expected cuda, as torch sees it"),
        (1, "cuda:1", "auto", "1 CUDA device; expected cuda:1, as torch sees it"),
        (1, "cuda", "cpu", "--engine cpu"),
        (1, "cpu", "cuda", "--engine cuda"),
    ],
)
def test_what_is_not_there_or_cannot_be_drawn_on_is_refused(gpus, count, wanted, engine, words):
    gpus(count)
    with pytest.raises(UsageError, match=f"--device {wanted}: {words}"):
        engines.device_for(wanted, engine)


DRAWS = ("render", __file__, "--data", "d", "--out", "o")


@pytest.mark.parametrize("word", ["gpu", "cuda:", "cuda:x", "cuda:-1", "mps", ""])
@pytest.mark.parametrize(
    "command", [DRAWS, ("run", "--", "train.py"), ("bench",), ("demo",)], ids=lambda words: words[0]
)
def test_other_words_are_usage(command, word):
    result = run(command[0], "--device", word, *command[1:])
    assert result.exit_code == 2
    assert "is not one of auto, cpu, cuda, cuda:N" in result.stderr


@pytest.mark.parametrize(
    ("count", "usable", "wanted", "device"),
    [(0, True, "auto", "cpu"), (1, False, "auto", "cuda"), (2, True, "cuda:1", "cuda:1")],
)
def test_a_host_gets_any_gpu_there_is(gpus, count, usable, wanted, device):
    """Its own rasterizer may draw where our engine may not."""
    gpus(count, usable)
    assert process.host_device(wanted, "auto") == device


def test_a_host_stays_on_the_gpu_that_was_named(gpus, tmp_path, monkeypatch):
    """Hosts choose cuda:0 themselves."""
    gpus(2)
    current = [0]

    @contextlib.contextmanager
    def device(name):
        current.append(torch.device(name).index)
        yield
        current.pop()

    monkeypatch.setattr(torch.cuda, "device", device)
    monkeypatch.setattr(torch.cuda, "set_device", current.append)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: current[-1])
    skeleton(tmp_path)
    script = tmp_path / "train.py"
    script.write_text(
        "import torch, pathlib\n"
        "torch.cuda.set_device(0)\n"
        "pathlib.Path(__file__).with_name('seen').write_text(str(torch.cuda.current_device()))\n"
        + FLAGS
    )
    launch.run([str(script)], RunOptions(stage="off", device="cuda:1"))
    assert (tmp_path / "seen").read_text() == "1"
    assert current == [0]
