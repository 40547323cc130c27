"""Proves what fragprune is worth on one machine: first that it draws rightly, then how fast.

Every engine that runs here, and every other rasterizer that is installed, draws fixed scenes. Its
pictures and gradients are compared with the oracle's. So are those of the cuda engine's kernels as
the CPU runs them, emulated. Only engines that agree are timed, all in turns; nothing emulated is.
"""

from __future__ import annotations

import datetime
import hashlib
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import click
import torch
from torch import Tensor

from fragprune_plugins.constants import VERSION
from fragprune_plugins.engines import Engine
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.cpu.engine import CpuEngine
from fragprune_plugins.engines.cuda import comparison, driver, kernels
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.errors import FragpruneError
from fragprune_plugins.slicing.cutting import expect_right
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.bench import timing
from fragprune_plugins.workbench.bench.scene import make_scene, make_view
from fragprune_plugins.workbench.bench.timing import Case
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.doctor import emulated, peers
from fragprune_plugins.workbench.doctor.emulated import EmulatedDevice, find_compiler, version_of
from fragprune_plugins.workbench.doctor.peers import Peer

FORMAT = "fragprune-proof 2"

SCENES = {
    "cpu": ((100_000, (640, 480)),),
    "cuda": ((100_000, (640, 480)), (1_000_000, (1920, 1080))),
}
"""Gaussians and size of the timed pictures, by the kind of device."""

_NOT_EMULATED = "no C++17 compiler on Linux: install g++, or name one with CXX, and prove again"
_CLOCKS = ("driver_version", "clocks.sm", "clocks.max.sm", "clocks.mem", "temperature.gpu")


def prove(repeats: int = 9) -> Report:
    """Check, then time ``repeats`` frames of each row; stderr is told how far."""
    kind = "cuda" if torch.cuda.is_available() else "cpu"
    engines, left_out = _ours(kind), {}
    for name in peers.installed():
        if kind == "cuda":
            engines[name] = peers.peer(name)
        else:
            left_out[name] = "it runs on a GPU only, and torch sees none"
    if kind == "cuda" and (missing := driver.missing()) is not None:
        left_out["cuda"] = missing
    if not binding.available():
        left_out["cpu"] = str(binding.chosen())
    checks = [_check(name, engine, kind) for name, engine in engines.items()]
    emulation = _emulation()
    passed = {c["name"]: engines[c["name"]] for c in checks if not c["differences"]}
    data: dict[str, Any] = {
        "format": FORMAT,
        "fragprune": VERSION,
        "when": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "machine": timing.describe_machine(kind) | {"load_before": timing.load_average()},
        "clocks": _clocks() if kind == "cuda" else None,
        "peers": peers.installed(),
        "hashes": _hashes(),
        "left_out": left_out,
        "checks": checks,
        "emulation": emulation,
        "times": list(_times(passed, kind, repeats)),
    }
    data["machine"]["load_after"] = timing.load_average()
    return Report(data, _text(data), exit_code=0 if _proved(data) else 1)


def _say(text: str) -> None:
    click.echo(text, err=True)


def _proved(data: dict[str, Any]) -> bool:
    """Whether our engines, and our kernels on a GPU or emulated, were held and agree."""
    ours = [check for check in data["checks"] if check["ours"]]
    kernels_held = data["emulation"]["not_proved"] is None or any(c["name"] == "cuda" for c in ours)
    wrong = any(check["differences"] for check in [*ours, data["emulation"]])
    return bool(ours) and kernels_held and not wrong


def _ours(kind: str) -> dict[str, Engine]:
    """Our engines that run here, which know thresholds, and must equal the oracle in everything."""
    builds = binding.usable_builds()
    found: dict[str, Engine] = {f"cpu ({b})": CpuEngine(binding.open_build(b)) for b in builds}
    if kind == "cuda" and driver.missing() is None:
        found["cuda"] = CudaEngine()
    return found


def _check(name: str, engine: Engine, kind: str) -> dict[str, Any]:
    """Every difference from the oracle in float64; empty if there is none."""
    _say(f"checking {name}")
    where = "cpu" if isinstance(engine, CpuEngine) else kind
    if isinstance(engine, Peer):
        return {"name": name, "ours": False, "differences": list(peer_differences(engine, where))}
    return {"name": name, "ours": True} | _held([held(engine, where, each) for each in scenes()])


def _held(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Rows of ``held``, and all that is wrong in them."""
    return {"differences": [each for row in rows for each in row["differences"]], "scenes": rows}


def _emulation() -> dict[str, Any]:
    """The kernels' own text, run on the CPU; a frame draws as on a GPU, and takes no such time."""
    compiler = find_compiler()
    if compiler is None:
        return {"compiler": None, "not_proved": _NOT_EMULATED} | _held([])
    with tempfile.TemporaryDirectory(prefix="fragprune-") as folder:
        device = EmulatedDevice(compiler, Path(folder))
        engine = CudaEngine(device, deterministic=False)
        engine.capacity = 1 << 13  # each entry that there is room for costs time
        rows = []
        for scene in scenes():
            _say(f"emulating the cuda kernels: {scene.scene}")
            rows.append(held(engine, "cpu", scene))
        found = _held(rows)
        _say("emulating the cuda kernels: a cut in time")
        try:
            expect_right(device, torch.device("cpu"))
        except (FragpruneError, RuntimeError) as error:
            found["differences"].append(f"a cut in time: {str(error).splitlines()[0]}")
    return {"compiler": version_of(compiler), "not_proved": None} | found


def _times(engines: Mapping[str, Engine], kind: str, repeats: int) -> Iterator[dict[str, Any]]:
    """Rows of all that passed and draw on the device, timed in turns."""
    timed = {k: e for k, e in engines.items() if kind == "cpu" or not isinstance(e, CpuEngine)}
    ours = {name: each for name, each in timed.items() if not isinstance(each, Peer)}
    for count, size in SCENES[kind]:
        cases = timing.generated(count, size, kind)
        plain = [case for case in cases if case.thresholds is None]
        rounds = [("truncation", cases, ours)]
        rounds += [("peers", plain, timed)] if len(timed) > len(ours) else []
        for what, some, turns in rounds:
            if not turns:
                continue
            _say(f"timing {what}: {count:,} Gaussians at {size[0]}x{size[1]}")
            rows = timing.measure(some, [*turns.values()], repeats=repeats)
            for name, row in zip([*turns] * len(some), rows, strict=True):
                yield {"round": what} | row | {"engine": name}


def _hashes() -> dict[str, str]:
    """What was proved: the compiled libraries, the kernels' sources, the timed scene."""
    paths = {build: Path(binding.open_build(build).path) for build in binding.usable_builds()}
    found = {build: _digest(path.read_bytes()) for build, path in paths.items()}
    scene = make_scene(1000)
    numbers = b"".join(t.numpy().tobytes() for t in (scene.xyz, scene.opacity, scene.scaling))
    return found | {
        "kernels": _digest(kernels.digest_of_sources()),
        "emulation": _digest(b"".join(map(Path.read_bytes, sorted(emulated.EMULATION.iterdir())))),
        "scene": _digest(numbers),
    }


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _clocks() -> dict[str, str] | None:
    """Driver, clocks in MHz and temperature of the GPU, as nvidia-smi tells them."""
    command = ["nvidia-smi", f"--query-gpu={','.join(_CLOCKS)}", "--format=csv,noheader,nounits"]
    with suppress(OSError, ValueError, IndexError, subprocess.SubprocessError):
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
        values = done.stdout.splitlines()[0].split(", ")
        return dict(zip(_CLOCKS, values, strict=True))
    return None


def _text(data: dict[str, Any]) -> str:
    """What a person reads."""
    machine = data["machine"]
    lines = [f"{machine['processor']}, {machine['gpu'] or 'no GPU'}, torch {machine['torch']}", ""]
    for check in data["checks"]:
        verdict = "; ".join(check["differences"]) or "agrees with the oracle"
        lines.append(f"{check['name']}: {verdict}")
    emulation = data["emulation"]
    verdict = "; ".join(emulation["differences"]) or "agree with the oracle"
    if emulation["not_proved"]:
        verdict = f"NOT PROVED, {emulation['not_proved']}"
    lines.append(f"cuda kernels, emulated: {verdict}")
    lines += [f"{name}: left out, {why}" for name, why in data["left_out"].items()]
    if data["times"]:
        loads = [f"{machine[key]:.1f}" for key in ("load_before", "load_after") if machine[key]]
        lines += ["", _table(data["times"]), f"Load before and after: {' and '.join(loads)}."]
    if any(check["differences"] for check in data["checks"]):
        lines += ["", "Who disagrees was not timed."]
    return "\n".join(lines)


def _table(rows: Sequence[dict[str, Any]]) -> str:
    """Times in turns; a ratio is that to the untruncated row of the same engine."""
    form = "{:<28}{:>11}  {:<17}{:<8}{:>11}{:>9}{:>9}"
    lines = [form.format("engine", "size", "pass", "cutoffs", "median, ms", "±", "as fast")]
    plain: dict[tuple[str, ...], float] = {}
    for row in rows:
        key, took = (row["round"], row["engine"], row["scene"], row["pass"]), row["ms_median"]
        cut, faster = "no", ""
        if row["truncated"]:
            cut, faster = "yes", f"{plain[key] / took:.2f}x"
        else:
            plain[key] = took
        size, times = f"{row['width']}x{row['height']}", (f"{took:.2f}", f"{row['ms_se']:.2f}")
        lines.append(form.format(row["engine"], size, row["pass"], cut, *times, faster).rstrip())
    return "\n".join(lines)


MISCOUNTED = 1 / 500
"""The share of pixels whose fragments may be counted otherwise: within rounding of a cut it is one
in thousands; an error of a thousandth is seen in one in a hundred."""

PEER_PICTURE_DB, PEER_GRADIENT = 50.0, 0.01
"""PSNR of the picture and relative L2 error of each gradient that peers may be off by, which end
Gaussians at other radii."""

_FAILURES = (FragpruneError, RuntimeError, TypeError, AttributeError)


@cache
def scenes() -> tuple[Case, ...]:
    """Always the same, float32 on the CPU; small, for the oracle and the emulation are slow.

    In the last, several blocks sort, and tiles' lists are longer than a block's 256 threads.
    """
    inputs, thresholds = comparison.scene(200, (70, 50), 3.0)
    timed = RasterInputs(make_view(64, 48), make_scene(6000).splats())
    return (
        Case("cutoffs", inputs, thresholds),
        Case("no cutoffs", inputs, None),
        Case("a stop", replace(inputs, stop=0.05), thresholds),
        Case("the timed scene, small", timed, torch.full((6000,), timing.TRUNCATION)),
    )


def held(engine: Engine, where: str, scene: Case) -> dict[str, Any]:
    """A row of the proof: what an engine of ours draws of a scene, and what is wrong with it."""
    expected = _expected(scene)
    differences, counted = [], None
    try:
        found = _drawn(engine, comparison.on(scene.inputs, where), scene.thresholds)
    except _FAILURES as error:
        differences.append(f"{scene.scene}: it fails: {str(error).splitlines()[0]}")
    else:
        fragments = found.pop("fragments")
        counted = float(fragments.double().mean())
        right = {name: each for name, each in expected.items() if name != "fragments"}
        differences += comparison.differences(scene.scene, found, right)
        off, total = int((fragments != expected["fragments"]).sum()), fragments.numel()
        if off > MISCOUNTED * total:
            differences.append(f"{scene.scene}, fragments: {off} of {total} pixels count others")
    return {
        "scene": scene.scene,
        "gaussians": len(scene.inputs.splats),
        "width": scene.inputs.view.width,
        "height": scene.inputs.view.height,
        "truncated": scene.thresholds is not None,
        "stop": scene.inputs.stop,
        "fragments_per_pixel": counted,
        "fragments_per_pixel_of_oracle": float(expected["fragments"].double().mean()),
        "differences": differences,
    }


@cache
def _expected(scene: Case) -> dict[str, Tensor]:
    """What the oracle draws."""
    wide = comparison.on(scene.inputs, "cpu", torch.float64)
    return _drawn(ReferenceEngine(), wide, scene.thresholds)


def _drawn(engine: Engine, inputs: RasterInputs, thresholds: Tensor | None) -> dict[str, Tensor]:
    """The picture, its gradients by name, and (H, W) drawn fragments; on the CPU."""
    found = comparison.drawn_and_learned(engine, inputs, thresholds)
    cut = None if thresholds is None else thresholds.to(inputs.splats.opacities)
    with torch.no_grad():
        fragments = engine.rasterize(replace(inputs, counts=True), cut).fragments
    assert fragments is not None  # they were asked for
    return found | {"fragments": fragments.cpu()}


def peer_differences(engine: Engine, where: str) -> Iterator[str]:
    """Where another rasterizer, which knows no thresholds, draws otherwise than the oracle."""
    inputs = scenes()[0].inputs
    wide = comparison.on(inputs, "cpu", torch.float64)
    expected = comparison.drawn_and_learned(ReferenceEngine(), wide, None)
    try:
        found = comparison.drawn_and_learned(engine, comparison.on(inputs, where), None)
    except _FAILURES as error:
        yield f"it fails: {str(error).splitlines()[0]}"
        return
    mse = float((found["picture"].double() - expected["picture"]).square().mean())
    if not mse <= 10 ** (-PEER_PICTURE_DB / 10):
        yield f"another picture: its mean squared error is {mse:.2g}"
    for name in (f"gradient of {each}" for each in comparison.LEARNED):
        right = expected[name]
        away = float((found[name].double() - right).norm() / right.norm())
        if not away <= PEER_GRADIENT:
            yield f"another {name}: off by {away:.1%}"
