"""The emulation notices what it is there to notice."""

import pytest
import torch
from gpu.emulated import BrokenDevice, Numbers

from fragprune_plugins.workbench.doctor.emulated import EmulatedDevice


@pytest.fixture(scope="module")
def broken(device: EmulatedDevice, tmp_path_factory: pytest.TempPathFactory) -> BrokenDevice:
    return BrokenDevice(device.compiler, tmp_path_factory.mktemp("broken"))


def run(device: BrokenDevice, kernel: str, blocks: int = 3) -> torch.Tensor:
    to = torch.zeros(blocks * 256, dtype=torch.int32)
    device.launch(to.device, "broken", {}, kernel, blocks, Numbers(to=to.data_ptr()))
    return to


def test_a_missing_barrier_shows(broken):
    expected = torch.arange(255, -1, -1, dtype=torch.int32).repeat(3)
    assert torch.equal(run(broken, "fp_with_barrier"), expected)
    assert not torch.equal(run(broken, "fp_no_barrier"), expected)


@pytest.mark.parametrize(
    ("kernel", "message"),
    [
        ("fp_parted", "different barriers"),
        ("fp_left", "left while others wait for it at a barrier"),
        ("fp_lane_left", "a lane has left"),
        ("fp_half_a_warp", "a lane has left"),
        ("fp_waits_forever", "forever"),
        ("fp_unheard_of", "no such kernel"),
    ],
)
def test_threads_that_lose_each_other_are_reported(broken, kernel, message):
    with pytest.raises(RuntimeError, match=message):
        run(broken, kernel)
