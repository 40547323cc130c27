"""What the cuda engine is held against on a GPU: the whole of it, with the emulation as the GPU."""

import ctypes
import itertools

import pytest
import torch
from gpu.emulated import Watched
from gpu.holding import Holding

from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.cuda import comparison, frame
from fragprune_plugins.engines.cuda import engine as cuda
from fragprune_plugins.engines.cuda.comparison import Workload, compare
from fragprune_plugins.workbench.doctor.emulated import EmulatedDevice

CPU = torch.device("cpu")
SMALL = Workload(
    keys=9000, gaussians=1500, size=(90, 50), wide_gaussians=150, wide_size=(330, 290), steps=3
)


def array(address: int, count: int, kind: type = ctypes.c_float) -> ctypes.Array:
    """Memory that a kernel was handed."""
    return (kind * count).from_address(address)


@pytest.fixture(autouse=True)
def memory(monkeypatch: pytest.MonkeyPatch):
    with Holding() as holding:
        monkeypatch.setattr(comparison, "bytes_held", lambda where: holding.held)
        yield


def test_a_sound_engine_agrees(device):
    assert compare(device, CPU, SMALL) == []


RUNS = itertools.count()


@pytest.mark.slow  # compiles every kernel anew
def test_the_rounding_of_a_gpus_special_units_is_no_fault(device, tmp_path):
    assert (
        compare(EmulatedDevice(device.compiler, tmp_path, ("-DEMULATED_ROUGH",)), CPU, SMALL) == []
    )


def no_stable_sort(kernel: str, arguments: ctypes.Structure) -> None:
    if kernel == "fp_sort" and arguments.capacity == SMALL.keys:
        order = array(arguments.sorted_values, SMALL.keys, ctypes.c_uint32)
        order[5000], order[5001] = order[5001], order[5000]


def a_faint_error_in_a_sub_tile(kernel: str, arguments: ctypes.Structure) -> None:
    if kernel == "fp_blend":
        width = arguments.inputs.width
        pixels = array(arguments.outputs.image, width * arguments.inputs.height)
        for y in range(32, 36):
            for x in range(16, 24):
                pixels[y * width + x] += 1e-4


def a_block_of_rows_without_gradients(kernel: str, arguments: ctypes.Structure) -> None:
    if kernel == "fp_chain" and arguments.frame.inputs.count > 512:
        ctypes.memset(arguments.to.opacities + 4 * 256, 0, 4 * 256)


def another_picture_each_time(kernel: str, arguments: ctypes.Structure) -> None:
    if kernel == "fp_blend":
        array(arguments.outputs.image, 1)[0] += 1e-6 * next(RUNS)


def other_gradients_each_time(kernel: str, arguments: ctypes.Structure) -> None:
    if kernel == "fp_chain":
        array(arguments.to.means, 1)[0] *= 1 + 1e-6 * next(RUNS)


def nothing_in_the_widest_rows_of_tiles(kernel: str, arguments: ctypes.Structure) -> None:
    if kernel == "fp_blend" and arguments.inputs.width == SMALL.wide_size[0]:
        ctypes.memset(arguments.outputs.image + 4 * 330 * 288, 0, 4 * 330 * 2)


@pytest.mark.parametrize(
    ("fault", "part", "said"),
    [
        (no_stable_sort, "sorting", "of 9000 are not where torch.sort has them"),
        (
            a_faint_error_in_a_sub_tile,
            "large",
            "large frame, picture: 32 of 4500 are off, 32 of them",
        ),
        (a_block_of_rows_without_gradients, "large", "large frame, gradient of opacities: 2"),
        (another_picture_each_time, "large", "large frame: picture is another in another run"),
        (other_gradients_each_time, "large", "gradient of means is another in another run"),
        (nothing_in_the_widest_rows_of_tiles, "wide", "wide frame, picture: 660 of"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_fault_is_found(device, fault, part, said):
    assert said in "; ".join(only(part, Watched(device, fault)))


def only(part: str, device: EmulatedDevice | Watched) -> list[str]:
    """What one part of the comparison says; a sound engine shows that the whole runs each part."""
    parts = {
        "sorting": (comparison._sorting, SMALL.keys),
        "large": (comparison._large_frame, SMALL),
        "wide": (comparison._wide_frame, SMALL),
    }
    compared, *how = parts[part]
    return list(compared(device, CPU, *how))


def test_memory_that_frames_leave_behind_is_found(device, monkeypatch):
    left = []

    class Leaking(frame.Drawing):
        def draw(self, *given, **how) -> dict[str, torch.Tensor | None]:
            drawn = super().draw(*given, **how)
            left.append(drawn["alpha"])
            return drawn

    monkeypatch.setattr(cuda, "Drawing", Leaking)
    (found,) = only("large", device)
    assert "bytes more are held after 3 steps" in found


def test_without_the_cpu_engine_large_frames_are_compared_with_themselves(device, monkeypatch):
    monkeypatch.setattr(binding, "available", lambda: False)
    assert only("large", device) == []
    found = only("large", Watched(device, another_picture_each_time))
    assert "large frame: picture is another in another run" in found
