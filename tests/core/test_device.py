"""``--device cpu``: what names CUDA runs on the CPU, and afterwards nothing has happened."""

import contextlib
import copy
from concurrent.futures import ThreadPoolExecutor
from threading import Thread

import pytest
import torch

from fragprune_plugins.injection import cpu_only as redirection
from fragprune_plugins.injection.cpu_only import cpu_only

run = Thread.run

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
    assert Thread.run is run


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
