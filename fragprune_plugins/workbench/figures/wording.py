"""Turns measurements into text: a table, and a sentence to quote."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fragprune_plugins.files.reading import lies_in
from fragprune_plugins.learning.goals import Fewer
from fragprune_plugins.workbench.figures.records import CONTROL
from fragprune_plugins.workbench.goals import Faster, parse_goal

_EQUAL = 0.005  # a ratio of fragments that reads 1.00
CLAIMED = 2  # frame times count as different if they differ by this many standard errors
WITHIN_NOISE = "no difference beyond the noise"
FELL = 0.5  # a loss of PSNR, in dB, that is warned of

CONTROLLED_BY = {
    "run": "--stage finetune --control to the same command",
    "finetune": "--control to the same command, with another --out in the same folder",
}
"""How a user runs a control so that later results find it."""

IS_CONTROL = ": a control, nothing is truncated."  # ends the sentence on one
ITSELF = "itself"  # the target of a measurement against the model's own pictures, as it came in
VISIBLE = 35.0  # a PSNR against itself, in dB, below which one is warned

_ROWS = (
    ("PSNR, dB", "psnr", 2),
    ("SSIM", "ssim", 4),
    ("LPIPS", "lpips", 4),
    ("fragments per pixel", "fragments_per_pixel", 2),
    ("area per pixel, other viewers", "area_per_pixel", 2),
    ("frame, ms", "frame_ms", 2),
    ("Gaussians", "gaussians", 0),
)

_DIFFERENCES = ("psnr", "ssim", "lpips")  # their change is a difference, that of others a ratio


def columns_of(data: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The measurements of a fine-tuning by the words for its models, those that were made."""
    learned = "control" if data["settings"]["goal"] == CONTROL else "pruned"
    columns = {"original": data.get("before"), learned: data.get("after")}
    return {name: each for name, each in columns.items() if each}


def profiled(data: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The measurements of a profile by what people read for them."""
    columns = data["columns"]
    what = "its stop" if len(columns) > 1 and not data["truncated"] else "cutoffs"
    named = {"untruncated": f"without {what}", "truncated": f"with {what}"}
    return {named[key]: each for key, each in columns.items()}


def describe(columns: Mapping[str, dict[str, Any]]) -> str:
    """A table with a column for each measurement, and the change between the last two."""
    form = "{:<31}" + "{:>16}" * len(columns) + ("{:>15}" if len(columns) > 1 else "")
    return "\n".join([*(form.format(*row) for row in tabulate(columns)), measured_with(columns)])


def measured_with(columns: Mapping[str, dict[str, Any]]) -> str:
    """What the last measurement was made with: views, engine, device."""
    *_, report = columns.values()
    made = f"{report['engine']} engine on {report['device']}"
    return f"Means over {_views(report)}, ± a standard error; {made}"


def tabulate(columns: Mapping[str, dict[str, Any]]) -> list[list[str]]:
    """Rows of a table, its head first: a figure, each measurement's, and the last two's change."""
    reports = list(columns.values())
    change = ["change"] if len(reports) > 1 else []
    rows = [["", *columns, *change]]
    itself = reports[-1].get("target") == ITSELF
    for label, key, digits in _ROWS:
        if key == "lpips" and any(each.get(key) is None for each in reports):
            continue  # an installation may lack it
        if key == "psnr" and itself:  # before, it is infinite: null in a record
            equal = ["equal" if _same(each) else f"{each[key]:.2f}" for each in reports]
            rows.append(["PSNR to itself, dB", *equal, *([""] if change else [])])
            continue
        cells = [f"{report[key]:.{digits}f}" for report in reports]
        if key == "frame_ms":
            errors = [f"{report['frame_ms_se']:.{digits}f}" for report in reports]
            cells = [" ± ".join(pair) for pair in zip(cells, errors, strict=True)]
        if change:
            first, last = reports[-2][key], reports[-1][key]
            if key in _DIFFERENCES:
                cells.append(f"{last - first:+.{digits}f}")
            elif key == "frame_ms":
                ratio, _, claimed = faster(*reports[-2:])
                cells.append(f"{ratio:.2f}x as fast" if claimed else "within noise")
            else:
                cells.append(_less(first, last, "less" if key == "area_per_pixel" else "fewer"))
        rows.append([label, *cells])
    return rows


def sizes(pictures: Sequence[tuple[int, ...]]) -> str:
    """WIDTHxHEIGHT of pictures; of the smallest and the largest, if they differ."""
    ends = min(pictures), max(pictures)
    return " to ".join(dict.fromkeys(f"{width}x{height}" for width, height in ends))


def nothing_drawn(fragments: Sequence[float]) -> list[str]:
    """A warning where no Gaussian is seen; [] where each view or measurement has some."""
    empty = sum(each == 0 for each in fragments)
    which = f"{empty} of {len(fragments)} show" if len(fragments) > 1 else "The pictures show"
    said = f"{which} no Gaussian (0.0 fragments per pixel). Are these the cameras of this model?"
    return [said] if empty else []


def gain(before: dict[str, Any], after: dict[str, Any], enlarge: int = 1) -> str:
    """A phrase for the gain of one measurement over another: fragments, frame times, PSNR."""
    return (
        f"{fewer(before['fragments_per_pixel'], after['fragments_per_pixel'])}, "
        f"{frames(before, after, enlarge)}, {quality(before, after)} on {_views(after)}"
    )


def _views(report: dict[str, Any]) -> str:
    """How many views a measurement is of."""
    return f"{report['views']} view" + ("" if report["views"] == 1 else "s")


def quality(before: dict[str, Any], after: dict[str, Any]) -> str:
    """A phrase for what became of the picture."""
    if after.get("target") == ITSELF:
        return "equal pictures" if _same(after) else f"{after['psnr']:.2f} dB PSNR against itself"
    return f"{after['psnr'] - before['psnr']:+.2f} dB PSNR"


def _same(report: dict[str, Any]) -> bool:
    """Whether pictures equalled their targets: PSNR is infinite, or None in a record."""
    return report["psnr"] is None or math.isinf(report["psnr"])


def outcome(command: str, data: dict[str, Any], control: dict[str, Any] | None) -> str:
    """A sentence for the gain of a fine-tuning on held-out views, and for the control's share.

    In its figures, "seen" is whether the training before it held nothing out. The control is what
    as many iterations without truncation gave, if they were run.
    """
    before, after = data["before"], data["after"]
    held = f"that {'was' if after['views'] == 1 else 'were'} held out"
    held = "that its training had seen" if data.get("seen") else held
    if data["settings"]["goal"] == CONTROL:
        then = IS_CONTROL
    elif after.get("target") == ITSELF:
        then = ". No photograph was used."
    elif control is None:
        then = (
            ". More training alone may be a part of the dB: no control was found; "
            f"to see, add {CONTROLLED_BY[command]}."
        )
    else:
        then = (
            ". The control, as many iterations without pruning, has "
            f"{control['fragments_per_pixel']:.1f} fragments per pixel and "
            f"{control['psnr'] - before['psnr']:+.2f} dB: pruning itself makes "
            f"{_by_pruning(before, after, control):+.2f} dB."
        )
    # What unlearns its photographs by dropout is worse on them, and better on others.
    unlearned = data.get("seen") and data["settings"].get("dropout")
    fell = "" if unlearned else _fell(before, after, control)
    return f"{gain(before, after)} {held}{then}{missed(data)}{fell}"


def outcome_in_training(data: Mapping[str, Any]) -> str:
    """A sentence for the gain of a run on training views, where no others were measured."""
    seen = data["training_views"]
    change = fewer(seen["fragments_per_pixel_before"], seen["fragments_per_pixel_after"])
    end = IS_CONTROL if data["settings"]["goal"] == CONTROL else f".{missed(data)}"
    left = "" if data.get("keep") in (None, 1) else ", counted from what was left"
    return f"{change} on training views{left}; frame times were not measured{end}"


def headlines(data: Mapping[str, Any], control: dict[str, Any] | None) -> list[tuple[str, str]]:
    """Fragments, frame time, picture of a fine-tuning: (the figure, what it says) of each."""
    before, after = data["before"], data["after"]
    slow, fast = (each["frame_ms"] for each in (before, after))
    ratio, _, claimed = faster(before, after)
    if claimed:
        frame = f"{ratio:.2f}x", f"as fast: frames in {slow:.2f} → {fast:.2f} ms"
    else:  # no ratio: a busy machine tells none
        frame = f"{slow:.1f} → {fast:.1f} ms", f"for frames: {WITHIN_NOISE}"
    if after.get("target") == ITSELF:
        figure = "equal" if _same(after) else f"{after['psnr']:.1f} dB"
        against = "of the picture against the original's own"
    elif control is not None:
        figure = f"{_by_pruning(before, after, control):+.2f} dB"
        against = "against the same training without pruning"
    else:
        figure = f"{after['psnr'] - before['psnr']:+.2f} dB"
        against = "against the original; more training may be a part of it"
    drawn = _drawn(*(each["fragments_per_pixel"] for each in (before, after)))
    return [drawn, frame, (figure, f"PSNR {against}")]


def _drawn(was: float, now: float) -> tuple[str, str]:
    """The ratio of fragments per pixel, and what it says."""
    least, most = sorted((was, now))
    if not least:
        return f"{was:.1f} → {now:.1f}", "fragments to draw a pixel"
    ratio = most / least
    word = "as many" if ratio - 1 < _EQUAL else "fewer" if was > now else "more"
    figure = f"{ratio:.2f}x" if ratio < 1.1 else f"{ratio:.1f}x"
    return figure, f"{word} fragments to draw: {was:.1f} → {now:.1f} a pixel"


def _by_pruning(before: dict[str, Any], after: dict[str, Any], control: dict[str, Any]) -> float:
    """What pruning changes of the PSNR, dB: the difference of the two rounded gains."""
    gained, without = (round(float(each["psnr"] - before["psnr"]), 2) for each in (after, control))
    return gained - without


def next_steps(model: Path | None, folder: Path, scene: Path | None = None) -> str:
    """A line on what to do with a model that a command wrote, if ``view`` shows it, and with the
    record in a folder. Photographs in a ``scene`` elsewhere are read by ``report`` only by name.
    """
    look = f"Look at it: fragprune view {quoted(model)}. " if model else ""
    data = "" if scene is None or lies_in(scene, folder) else f" --data {quoted(scene)}"
    return f"{look}A page to share: fragprune report {quoted(folder)}{data}"


def quoted(path: object) -> str:
    """A path as a word of a command to copy, for a Windows shell or another, and no option."""
    word = f"./{path}" if str(path).startswith("-") else str(path)
    if os.name == "nt":
        return f'"{word}"' if " " in word else word
    return shlex.quote(word)


def begun(data: Mapping[str, Any]) -> list[str]:
    """Lines on a fine-tuning's trial, and on Gaussians removed before it or moved in it."""
    lines, dropout, keep = [], data["settings"].get("dropout"), data.get("keep")
    if data.get("forgotten") is not None and dropout:
        lines.append(
            f"A trial made other photographs {data['forgotten']:.2f} dB worse, so the model knew "
            f"its photographs by heart, and learned with --dropout {dropout:g}."
        )
    if keep not in (None, 1):
        why = "those whose removal changed the training views and views beside them least"
        if keep == "visible":
            why = "which reached no pixel of any view"
        measured = data["before"]  # a run whose views all were trained on has none
        whole = measured["gaussians"] if measured else data["gaussians_before"]
        left = data["after"]["gaussians"] if measured else data["gaussians"]
        lines.append(f"Removed {whole - left:,} of {whole:,} Gaussians before learning, {why}.")
    if moved := data.get("relocated"):
        lines.append(f"Moved {moved:,} of the others to where some were missing.")
    return lines


def bounded(data: Mapping[str, Any]) -> str:
    """A line on what --max-drop found, and on which views."""
    found = data["max_drop"]
    if "loss" not in found:
        return "No training was compared with the control."
    chosen = "the strongest pruning" if found["met"] else "the least loss"
    missed = "" if found["met"] else f" The bound of {found['bound']:g} dB was missed."
    return (
        f"Loss against the control: {found['loss']:.3f} dB at pressure {found['pressure']:.2g}, "
        f"{chosen} of {len(found['trials'])} trained. The pressure was chosen on these "
        f"{data['after']['views']} views; others of their kind may differ by some "
        f"{found['loss_se']:.2f} dB.{missed}"
    )


def missed(data: Mapping[str, Any]) -> str:
    """That a fine-tuning missed its target, a sentence with a space before it; else nothing."""
    if data.get("target_reached") is not False:
        return ""
    goal = parse_goal(data["settings"]["goal"])
    if isinstance(goal, Faster):
        target, met = f"frames {goal.ratio:g}x as fast", data.get("faster")
    else:
        assert isinstance(goal, Fewer)  # nothing else has a target
        target, met = f"{goal.ratio:g}x fewer fragments", data.get("speedup")
    got = f": {met:.2f}x there" if met else ""
    return (
        f" The target of {target} was missed by "
        f"more than 5 % on the training views{got}; more --iters or another target may help."
    )


def _fell(before: dict[str, Any], after: dict[str, Any], control: dict[str, Any] | None) -> str:
    """A warning where much PSNR was lost; else nothing."""
    if after.get("target") == ITSELF:
        shows = not _same(after) and after["psnr"] < VISIBLE
        return f" Warning: below {VISIBLE:g} dB the change can be seen." if shows else ""
    loss = (control or before)["psnr"] - after["psnr"]
    if loss <= FELL:
        return ""
    against = "the control" if control else "the model before"
    return f" Warning: PSNR fell by {loss:.2f} dB against {against}."


def fewer(before: float, after: float) -> str:
    """A phrase for the ratio of fragments per pixel: fewer, as many, more or none."""
    change = _less(before, after).replace("the same", "as many").replace("none", "no")
    return f"{change} fragments ({before:.1f} -> {after:.1f} per pixel)"


def _less(before: float, after: float, word: str = "fewer") -> str:
    """The ratio of two figures in words; nothing has no ratio."""
    if before == after or (before and abs(before / max(after, 1e-9) - 1) < _EQUAL):
        return "the same"
    if not before or not after:
        return "more" if after else "none"
    return f"{before / after:.2f}x {word}" if before > after else f"{after / before:.2f}x more"


def frames(before: dict[str, Any], after: dict[str, Any], enlarge: int = 1) -> str:
    """A phrase for frame times, with their ratio only if it exceeds the standard errors."""
    ratio, error, claimed = faster(before, after)
    change = f"{ratio:.2f} ± {error:.2f}x as fast" if claimed else WITHIN_NOISE
    of = f" of {enlarge}x the size" if enlarge > 1 else ""
    return f"frames{of} {before['frame_ms']:.2f} -> {after['frame_ms']:.2f} ms ({change})"


def faster(before: dict[str, Any], after: dict[str, Any]) -> tuple[float, float, bool]:
    """How many times as fast frames are, its standard error, and whether that is a difference."""
    times = [max(report["frame_ms"], 1e-9) for report in (before, after)]
    errors = [report["frame_ms_se"] for report in (before, after)]
    ratio = times[0] / times[1]
    relative = math.hypot(*(error / time for error, time in zip(errors, times, strict=True)))
    # Of the difference and of the logarithm, not of the ratio: which of the two comes first must
    # not decide. Where the shorter time is unsure, the difference alone would claim any factor.
    differs = abs(times[0] - times[1]) > CLAIMED * math.hypot(*errors)
    return ratio, ratio * relative, differs and abs(math.log(ratio)) > CLAIMED * relative
