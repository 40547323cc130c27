"""The sentence that one quotes: fragments, time and PSNR together, and the control beside them."""

from __future__ import annotations

import pytest

from fragprune_plugins.measure.wording import fewer, gain, outcome


def measured(fragments, ms, psnr, error=0.01):
    return {
        "fragments_per_pixel": fragments,
        "frame_ms": ms,
        "frame_ms_se": error,
        "psnr": psnr,
        "views": 7,
    }


BEFORE, AFTER = measured(39.1, 2.33, 30.09), measured(25.0, 2.07, 30.26)
CONTROL = measured(38.9, 2.31, 30.29)


def data(truncate=True):
    return {"before": BEFORE, "after": AFTER, "settings": {"truncate": truncate}}


def test_fragments_come_with_frame_times_and_psnr():
    assert gain(BEFORE, AFTER) == (
        "1.56x fewer fragments (39.1 -> 25.0 per pixel), frames 2.33 -> 2.07 ms "
        "(1.13 ± 0.01x as fast), +0.17 dB PSNR on 7 views"
    )


@pytest.mark.parametrize(
    ("ms", "error", "claim"),
    [
        (2.0, 0.01, "1.50 ± 0.01x as fast"),
        (6.0, 0.01, "0.50 ± 0.00x as fast"),
        (2.9, 0.06, "no difference beyond the noise"),
        (2.9, 0.01, "1.03 ± 0.00x as fast"),
    ],
)
def test_frames_are_called_faster_only_beyond_two_standard_errors(ms, error, claim):
    line = gain(measured(20, 3.0, 30, error), measured(10, ms, 30, error))
    assert f"frames 3.00 -> {ms:.2f} ms ({claim})" in line


def test_more_fragments_are_not_called_fewer():
    assert fewer(10.0, 25.0) == "2.50x more fragments (10.0 -> 25.0 per pixel)"
    assert fewer(25.0, 25.1) == "as many fragments (25.0 -> 25.1 per pixel)"


@pytest.mark.parametrize("command", ["run", "finetune"])
def test_training_that_had_no_control_is_not_credited_to_pruning(command):
    line = outcome(command, data(), None)
    assert line.startswith(gain(BEFORE, AFTER))
    assert "More training alone may be a part of the dB: no control was run" in line
    assert "--control" in line


def test_the_difference_to_the_control_is_quoted():
    line = outcome("run", data(), CONTROL)
    assert "has 38.9 fragments per pixel and +0.20 dB: pruning itself makes -0.03 dB." in line
    assert "no control" not in line


def test_a_control_says_that_it_is_one():
    line = outcome("finetune", data(truncate=False), None)
    assert "a control, nothing is truncated" in line
    assert "pruning" not in line
