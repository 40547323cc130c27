"""The sentence that one quotes: fragments, time and PSNR together, and the control beside them."""

import os
import shlex

import pytest

from fragprune_plugins.workbench.figures.wording import (
    begun,
    describe,
    fewer,
    gain,
    headlines,
    outcome,
    quoted,
)


def measured(fragments, ms, psnr, error=0.01, **more):
    figures = {"fragments_per_pixel": fragments, "frame_ms": ms, "frame_ms_se": error}
    others = {"views": 7, "ssim": 0.9, "area_per_pixel": 40.0, "gaussians": 9}
    return figures | others | {"psnr": psnr, "engine": "cpu", "device": "cpu"} | more


BEFORE, AFTER = measured(39.1, 2.33, 30.09), measured(25.0, 2.07, 30.26)
CONTROL = measured(38.9, 2.31, 30.29)


def data(goal="pressure"):
    return {"before": BEFORE, "after": AFTER, "settings": {"goal": goal}}


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
    before, after = measured(20, 3.0, 30, error), measured(10, ms, 30, error)
    assert f"frames 3.00 -> {ms:.2f} ms ({claim})" in gain(before, after)
    _, (figure, said), _ = headlines({"before": before, "after": after}, None)
    if "noise" in claim:
        assert (figure, said) == (f"3.0 → {ms:.1f} ms", f"for frames: {claim}")
    else:
        assert figure == f"{3.0 / ms:.2f}x"
        assert said == f"as fast: frames in 3.00 → {ms:.2f} ms"


def test_noise_is_noise_whichever_of_the_two_comes_first():
    quiet, noisy = measured(20, 1.0, 30, 0.0), measured(20, 1.6, 30, 0.35)
    slow, unsure = measured(20, 42.92, 30, 5.05), measured(20, 3.04, 30, 6.26)  # factor < error
    for pair in ((quiet, noisy), (noisy, quiet), (slow, unsure), (unsure, slow)):
        assert "no difference beyond the noise" in gain(*pair)


@pytest.mark.parametrize(
    ("was", "now", "said", "figure"),
    [
        *((20.0, 10.0, "2.00x fewer", "2.0x"), (20.0, 19.0, "1.05x fewer", "1.05x")),
        *((20.0, 19.98, "as many", "1.00x"), (20.0, 20.0, "as many", "1.00x")),
        (20.0, 40.0, "2.00x more", "2.0x"),
        # where nothing is drawn there is no ratio
        *((10.6, 0.0, "no", None), (0.0, 10.6, "more", None), (0.0, 0.0, "as many", None)),
    ],
)
def test_fragments_are_fewer_or_more_or_as_many(was, now, said, figure):
    assert fewer(was, now) == f"{said} fragments ({was:.1f} -> {now:.1f} per pixel)"
    first, *_ = headlines({"before": measured(was, 3, 30), "after": measured(now, 3, 30)}, None)
    both, word = f"{was:.1f} → {now:.1f}", said.rpartition("x ")[2]
    whole = (figure, f"{word} fragments to draw: {both} a pixel")
    assert first == (whole if figure else (both, "fragments to draw a pixel"))


@pytest.mark.parametrize("command", ["run", "finetune"])
def test_training_that_had_no_control_is_not_credited_to_pruning(command):
    line = outcome(command, data(), None)
    assert line.startswith(gain(BEFORE, AFTER))
    assert "More training alone may be a part of the dB: no control was found" in line
    assert "--control" in line


def test_the_difference_to_the_control_is_quoted():
    line = outcome("run", data(), CONTROL)
    assert "has 38.9 fragments per pixel and +0.20 dB: pruning itself makes -0.03 dB." in line
    assert "no control" not in line


TARGET = {"settings": {"goal": "fewer=8.0"}, "target_reached": False}


@pytest.mark.parametrize("control", [None, CONTROL])
def test_a_missed_target_is_a_part_of_the_result(control):
    for more, got in (({"speedup": 3.104}, ": 3.10x there; "), ({}, "views; ")):
        line = outcome("finetune", data() | TARGET | more, control)
        assert "The target of 8x fewer fragments was missed by more than 5 %" in line
        assert got in line
    assert "target" not in outcome("finetune", data() | TARGET | {"target_reached": True}, control)


def test_a_model_that_unlearns_photographs_it_had_seen_is_no_reason_to_warn():
    """Dropout makes it worse on these, and better on others."""
    seen = data() | {"after": AFTER | {"psnr": 25.0}, "seen": True}
    dropout = {"goal": "pressure", "dropout": 0.4}
    assert "Warning" in outcome("run", seen, CONTROL)
    assert "Warning" not in outcome("run", seen | {"settings": dropout}, CONTROL)
    assert "Warning" in outcome("run", seen | {"seen": False, "settings": dropout}, CONTROL)


@pytest.mark.parametrize(
    ("after", "control", "warning"),
    [
        (22.45, None, "Warning: PSNR fell by 7.64 dB against the model before."),
        (29.60, None, ""),
        (29.60, 30.29, "Warning: PSNR fell by 0.69 dB against the control."),
        (29.60, 29.20, ""),
    ],
)
def test_a_picture_that_is_worse_by_half_a_decibel_is_warned_of(after, control, warning):
    figures = data() | {"after": measured(5.0, 1.0, after)}
    line = outcome("finetune", figures, control and measured(39.0, 2.3, control))
    assert line.endswith(warning)
    assert ("Warning" in line) == bool(warning)


def test_one_view_is_no_views():
    figures = data() | {"after": AFTER | {"views": 1}}
    assert "dB PSNR on 1 view that was held out." in outcome("finetune", figures, None)


def test_a_control_says_that_it_is_one():
    line = outcome("finetune", data("control"), None)
    assert "a control, nothing is truncated" in line
    assert "pruning" not in line


@pytest.mark.parametrize("infinite", [float("inf"), None])  # None: read from a record
@pytest.mark.parametrize(("psnr", "warned"), [(45.2, False), (34.9, True), (None, False)])
def test_against_itself_there_is_no_figure_before_and_no_control(infinite, psnr, warned):
    before = measured(39.1, 2.33, infinite, target="itself")
    after = measured(25.0, 2.07, psnr or infinite, target="itself")
    figures = data() | {"before": before, "after": after}
    line = outcome("finetune", figures, None)
    quality = f"{psnr:.2f} dB PSNR against itself" if psnr else "equal pictures"
    assert f"{quality} on 7 views that were held out." in line
    assert "No photograph was used." in line
    assert "control" not in line
    assert ("Warning: below 35 dB the change can be seen." in line) == warned
    first, *_ = describe({"before": before, "after": after}).splitlines()[1:]
    shown = f"{psnr:.2f}" if psnr else "equal"
    assert first.split() == ["PSNR", "to", "itself,", "dB", "equal", shown]
    assert psnr or headlines(figures, None)[2][0] == "equal"


@pytest.mark.parametrize(
    ("before", "after", "change", "frame"),
    [
        (measured(39.0, 3.0, 30.0), measured(26.0, 2.0, 30.5), "1.50x fewer", "1.50x as fast"),
        (measured(26.0, 2.0, 30.0), measured(39.0, 4.0, 30.5), "1.50x more", "0.50x as fast"),
        (measured(26.0, 2, 30, 0.1), measured(26.1, 2.1, 30.5, 0.1), "the same", "within noise"),
    ],
)
def test_a_table_says_in_words_what_a_ratio_means(before, after, change, frame):
    text = describe({"original": before, "pruned": after | {"area_per_pixel": 32.0}})
    lines = {line[:31].strip(): line for line in text.splitlines()}
    assert lines["fragments per pixel"].endswith(f" {change}")
    assert lines["area per pixel, other viewers"].endswith(" 1.25x less")
    assert lines["frame, ms"].endswith(f" {frame}")
    assert lines["PSNR, dB"].endswith(" +0.50")
    assert text.endswith("Means over 7 views, ± a standard error; cpu engine on cpu")


def test_a_record_of_before_there_were_trials_says_nothing_of_one():
    before, after = {"gaussians": 9}, {"gaussians": 9}
    assert begun({"settings": {}, "before": before, "after": after}) == []


def test_gaussians_removed_are_told_where_nothing_was_measured():
    data = {"settings": {}, "keep": 0.6, "gaussians_before": 300, "gaussians": 180, "before": None}
    (said,) = begun(data)
    assert said.startswith("Removed 120 of 300 Gaussians")


@pytest.mark.skipif(os.name == "nt", reason="shells of Windows take other words")
@pytest.mark.parametrize("path", ["a.ply", "a b.ply", 'a"b$HOME`ls`.ply', "it's.ply", "-x.ply"])
def test_a_path_in_an_advised_command_is_one_word_and_no_option(path):
    (word,) = shlex.split(quoted(path))
    assert word in (path, f"./{path}")
    assert not word.startswith("-")
