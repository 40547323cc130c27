"""``--device``: one rule says where a command works, and on the CPU nothing stays redirected."""

import contextlib
import copy
from concurrent.futures import ThreadPoolExecutor
from threading import Thread

import pytest
import torch
from cli.commands import run
from miniatures.skeletons import FLAGS, skeleton

from fragprune_plugins import engines
from fragprune_plugins.errors import UsageError
from fragprune_plugins.injection import cpu_only as redirection
from fragprune_plugins.injection import launch, process
from fragprune_plugins.injection.cpu_only import cpu_only
from fragprune_plugins.injection.launch import RunOptions

RUN = Thread.run

FACTORIES = {
    "zeros": lambda d: torch.zeros(3, device=d),
    "full": lambda d: torch.full((2,), 7.0, device=d),
    "randint": lambda d: torch.randint(0, 3, (3,), device=d),
    "tensor": lambda d: torch.tensor([1, 2], device=d),
    "as_tensor": lambda d: torch.as_tensor([1, 2], device=d),
    "zeros_like": lambda d: torch.zeros_like(torch.ones(2), device=d),
    "new_zeros": lambda d: torch.ones(2).new_zeros(3, device=d),
    "to": lambda d: torch.ones(2).to(d),
    "to with dtype": lambda d: torch.ones(2).to(d, torch.float64),
    "to by keyword": lambda d: torch.ones(2).to(device=d),
    "device": lambda d: torch.ones(2, device=torch.device(d)),
    "module": lambda d: torch.nn.Linear(2, 2).to(d).weight,
    "parameter": lambda d: torch.nn.Parameter(torch.ones(2, device=d)),
}


@pytest.mark.parametrize("name", ["cuda:7", torch.device("cuda", 0), 0], ids=str)
@pytest.mark.parametrize("make", FACTORIES.values(), ids=FACTORIES)
def test_tensors_asked_for_on_cuda_are_made_on_the_cpu(make, name):
    with cpu_only():
        assert make(name).device.type == "cpu"


def test_cuda_methods_return_the_tensor_itself_as_on_a_gpu_they_would():
    tensor, module = torch.ones(2, requires_grad=True), torch.nn.Linear(2, 2)
    with cpu_only():
        assert tensor.cuda() is tensor
        assert tensor.cuda(0) is tensor
        assert tensor.cuda(non_blocking=True) is tensor
        assert tensor.pin_memory() is tensor
        assert module.cuda() is module
    assert module.weight.device.type == "cpu"


def test_what_only_looks_like_a_device_stays_what_it_is():
    """Numbers, flags and words."""
    assert redirection._redirected("cudaX") == "cudaX"
    with cpu_only():
        assert torch.nn.functional.pad(torch.ones(1, 2), (1, 1), mode="reflect").shape == (1, 4)
        assert torch.einsum("i,i->", torch.ones(2), torch.ones(2)) == 2
        assert torch.arange(3).sum(0) == 3
        assert torch.ones(2).to(torch.float64, True).dtype == torch.float64
        assert torch.nn.Linear(2, 2).to(torch.float64, True).weight.dtype == torch.float64
        assert torch.zeros(3, pin_memory=True, device="cpu").tolist() == [0, 0, 0]


def test_streams_order_nothing_and_random_numbers_come_from_the_cpu():
    with cpu_only():
        stream = torch.cuda.Stream(device=0, priority=-1)
        with torch.cuda.stream(stream), torch.cuda.device(0):
            tensor = torch.ones(2, device="cuda")
        torch.cuda.current_stream().wait_stream(stream)
        torch.cuda.current_stream().wait_event(stream.record_event())
        stream.synchronize()
        assert isinstance(copy.deepcopy(stream), type(stream))
        assert not hasattr(stream, "no_attribute_of_this_name")
        assert tensor.sum() == 2
        for made in (torch.Generator(device="cuda"), torch.Generator("cuda:0"), torch.Generator()):
            drawn = torch.rand(2, generator=made.manual_seed(3), device="cuda")
            assert torch.equal(drawn, torch.rand(2, generator=torch.Generator().manual_seed(3)))


def test_threads_that_a_host_starts_are_redirected_too():
    """Forks load their cameras in a pool of threads."""
    with cpu_only(), ThreadPoolExecutor(2) as pool:
        made = pool.map(lambda number: torch.full((1,), number, device="cuda").cuda(), range(9))
        assert [each.item() for each in made] == list(range(9))
    assert Thread.run is RUN


def test_a_tensors_device_can_be_handed_on():
    """Outside, its number is -1, and no tensor goes there."""
    with cpu_only():
        assert torch.ones(2).to(torch.zeros(1).get_device()).sum() == 2


def test_events_measure_and_calls_without_a_meaning_do_nothing():
    with cpu_only():
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        sum(range(10_000))
        end.record()
        torch.cuda.synchronize()
        end.synchronize()
        assert end.query()
        assert 0 < start.elapsed_time(end) < 1000
        torch.cuda.set_device(torch.device("cuda:0"))
        torch.cuda.empty_cache()
        assert torch.cuda.memory_allocated() == torch.cuda.current_device() == 0
        total = torch.cuda.get_device_properties(0).total_memory
        assert torch.cuda.mem_get_info() == (total, total)
        assert torch.cuda.is_available() in (True, False)  # hosts ask; we do not lie


@pytest.mark.parametrize("where", [{}, {"map_location": "cuda"}, {"map_location": "cuda:0"}])
def test_checkpoints_load_to_the_cpu(tmp_path, where):
    torch.save({"a": torch.arange(3)}, tmp_path / "x.pth")
    with cpu_only():
        assert torch.load(tmp_path / "x.pth", **where)["a"].device.type == "cpu"
        assert torch.load(tmp_path / "x.pth", "cuda")["a"].tolist() == [0, 1, 2]
        assert torch.load(tmp_path / "x.pth", weights_only=True)["a"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("error", [None, ValueError, KeyboardInterrupt])
def test_everything_is_put_back_however_the_block_ends(error):
    def substituted():
        names = redirection._SUBSTITUTES
        return [torch.load, torch.Generator, *(getattr(torch.cuda, name) for name in names)]

    before = substituted()
    with pytest.raises(error) if error else contextlib.nullcontext(), cpu_only():
        assert torch.cuda.Event not in before
        if error:
            raise error
    assert substituted() == before


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
