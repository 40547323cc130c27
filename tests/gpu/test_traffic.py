"""What is counted of memory's traffic, against numbers by hand; a block has 8 warps."""

from pathlib import Path

import pytest
import torch
from gpu.emulated import HERE, Numbers
from gpu.traffic import KINDS, CountingDevice

from fragprune_plugins.workbench.doctor.emulated import EmulatedDevice


class Patterns(CountingDevice):
    def source(self, name: str) -> Path:
        return HERE / "patterns.cu"


@pytest.fixture(scope="module")
def counting(device: EmulatedDevice, tmp_path_factory: pytest.TempPathFactory) -> Patterns:
    return Patterns(device.compiler, tmp_path_factory.mktemp("counting"))


@pytest.mark.parametrize(
    ("kernel", "kind", "requests", "lanes", "units", "least"),
    [
        ("fp_row", "write", 8, 256, 32, 32),
        ("fp_every_eighth", "write", 8, 256, 256, 256),
        ("fp_twice", "write", 16, 512, 64, 32),
        ("fp_half_of_a_warp", "write", 8, 128, 16, 16),
        ("fp_fours", "write", 8, 256, 128, 128),
        ("fp_adds", "atomic", 8, 256, 8, 1),
        ("fp_banks", "shared", 8, 256, 8, 8),
        ("fp_one_bank", "shared", 8, 256, 256, 8),
        ("fp_two_banks", "shared", 8, 256, 128, 8),
        ("fp_one_word", "shared", 8, 256, 8, 8),
        ("fp_shared_fours", "shared", 8, 256, 32, 32),
    ],
)
def test_sectors_and_turns_are_the_patterns(counting, kernel, kind, requests, lanes, units, least):
    room = torch.zeros(8 * 256 + 8, dtype=torch.int32)
    place = -(-room.data_ptr() // 32) * 32  # a sector begins there
    counting.launch(room.device, "patterns", {}, kernel, 3, Numbers(to=place))
    found = dict(zip(KINDS, counting.traffic[kernel].tolist(), strict=True))
    assert found.pop(kind) == [3 * each for each in (requests, lanes, units, least)]
    assert not any(map(any, found.values()))
