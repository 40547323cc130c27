"""Counted instructions: what a frame costs, whatever else the machine does.

Counts repeat exactly, and so do those of another build by the same compiler. Another compiler
moves a stage by some per cent (-O2 alone: by 25), so that recorded counts are compared for the one
that they are of; relations hold for all. 10 % above the record fail: that leaves room for a
compiler's minor version, and is less than each of the losses this guards against. Who makes a stage
cheaper writes the new counts down.
"""

import re
import shutil
from pathlib import Path

import pytest
from native.counting import counts, scene

from fragprune_plugins.engines.cpu import binding

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("valgrind") is None, reason="no valgrind here"),
    pytest.mark.skipif("avx2" not in binding.usable_builds(), reason="no AVX2 build here"),
]

TOLERANCE = 1.10
COMPILER = rb"GCC: \([^)]*\) 12\."

RECORDED = {  # millions, of 4,000 Gaussians on 320x320 pixels
    ("forward", 0.0): {"project": 1.44, "list": 0.51, "blend": 14.16},
    ("forward", 0.12): {"project": 1.41, "list": 0.46, "blend": 9.72},
    ("opacity", 0.0): {"blend": 16.09, "backward": 14.58},
    ("opacity", 0.12): {"blend": 12.16, "backward": 14.67},
    ("all", 0.12): {"blend": 12.16, "backward": 20.37},
}


@pytest.mark.parametrize(("kind", "falloff"), RECORDED)
def test_no_stage_costs_more_than_is_written_down(kind, falloff):
    if re.search(COMPILER, Path(binding.open_build("avx2").path).read_bytes()) is None:
        pytest.skip("this build is not of the compiler that the record is of")
    found = counts(*scene(320, 4000, falloff), kind=kind)
    for stage, recorded in RECORDED[kind, falloff].items():
        assert found[stage] / 1e6 < TOLERANCE * recorded, f"{stage}: {found[stage] / 1e6:.2f}"


def test_counts_repeat_exactly():
    case = scene(128, 500, 0.12)
    assert counts(*case, kind="all") == counts(*case, kind="all")


def test_a_pixel_of_an_empty_picture_costs_three_instructions_at_most():
    """One for four numbers of a plane would be 0.75; a background blended anew takes 30."""
    assert counts(*scene(1024, 0))["forward"] / 1024**2 < 3


def test_a_plane_that_nobody_asks_for_is_not_paid():
    image, whole = (
        counts(*scene(320, 4000, planes=planes))["blend"] for planes in ((), ("invdepth", "alpha"))
    )
    assert image < 0.98 * whole


def test_a_large_frame_follows_its_evaluated_pairs():
    plain, cut = (counts(*scene(1024, 10_000, falloff)) for falloff in (0.0, 0.12))
    fewer = plain["evaluated"] / cut["evaluated"]
    assert plain["forward"] / cut["forward"] > 0.85 * fewer
