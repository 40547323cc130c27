"""Instructions of the AVX2 build, counted by valgrind: the same number in every run.

    python tests/native/counting.py [--size 256] [--size 2048] [--gaussians 10000] [--falloff 0.0627]
    python tests/native/counting.py --model point_cloud.ply --cameras cameras.json

Prints, per row, millions of instructions by stage, of one thread; and the evaluated pairs. A time
says how busy the machine was, too; a count does not. `--library FILE` counts another build's.
"""

from __future__ import annotations

import argparse
import collections
import ctypes
import pickle
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from fragprune_plugins.engines.cpu import binding

STAGES = {
    "project": "fp::project_all(",
    "list": "fp::list_cells(",
    "blend": "fp::(anonymous namespace)::draw(",
    "forward": "fp::(anonymous namespace)::forward(",
    "backward": "fp::(anonymous namespace)::backward(",
}
"""The functions that are the stages, calls below them included."""


def counts(inputs: Any, thresholds: Any, *, wants: tuple[str, ...] = (), library: str = "") -> dict:
    """Instructions by stage of one frame; and `evaluated` and `drawn` per pixel.

    Args:
        inputs: a ``RasterInputs``.
        thresholds: (N,) or None.
        wants: gradients, by their names in fragprune_input_grads; none: the forward pass alone.
        library: a build's file; this checkout's AVX2 build when empty.
    """
    from fragprune_plugins.engines.inputs import native_arrays, native_inputs

    arrays = native_arrays(inputs, thresholds)
    given = native_inputs(inputs, arrays, widen="thresholds" in wants)
    scalars = {
        name: getattr(given, name)
        for name, kind in binding.Inputs._fields_
        if kind in (ctypes.c_int32, ctypes.c_int64, ctypes.c_float)
    }
    frame = {
        "library": str(Path(library).resolve()) if library else binding.open_build("avx2").path,
        "scalars": scalars,
        "arrays": {name: array.numpy().tobytes() for name, array in arrays.items()},
        "planes": getattr(inputs, "planes", ("invdepth", "alpha")),
        "wants": wants,
    }
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "frame").write_bytes(pickle.dumps(frame))
        command = ["valgrind", "--tool=callgrind", "--callgrind-out-file=costs"]
        command += [sys.executable, "-I", str(Path(__file__).resolve()), "--replay", "frame"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-4000:]
        found = inclusive((Path(folder) / "costs").read_text())
        tally = dict(zip(("evaluated", "drawn"), map(float, done.stdout.split()), strict=True))
    return {
        name: sum(n for f, n in found.items() if f.startswith(prefix) and "{lambda" not in f)
        for name, prefix in STAGES.items()
    } | tally


def inclusive(costs: str) -> dict[str, int]:
    """Instructions of each function and all that it calls, of callgrind's file."""
    names: dict[str, str] = {}
    total: collections.Counter[str] = collections.Counter()
    function = ""
    for line in costs.splitlines():
        if (match := re.match(r"(c?fn)=\((\d+)\)(?: (.*))?", line)) is not None:
            kind, number, name = match.groups()
            names.setdefault(number, name)
            function = names[number] if kind == "fn" else function
        elif re.match(r"[-+*\d]\S* \d", line):
            total[function] += int(line.split()[1])
    return total


def replay(path: str) -> None:
    """Draw a pickled frame, by ctypes alone: torch under valgrind takes minutes."""
    frame = pickle.loads(Path(path).read_bytes())
    calls = ctypes.CDLL(frame["library"])
    kept = {k: ctypes.create_string_buffer(v, len(v)) for k, v in frame["arrays"].items()}
    address = ctypes.addressof
    scalars = frame["scalars"] | {"threads": 1}
    n, pixels = scalars["count"], scalars["width"] * scalars["height"]
    lengths = {name: len(raw) // 4 for name, raw in frame["arrays"].items()}
    given = binding.Inputs(
        **{k: v for k, v in scalars.items() if k != "size"},
        lengths=binding.Lengths(**lengths),
        **{name: address(raw) for name, raw in kept.items()},
    )
    planes = {"image": 3 * pixels, "radii": n} | dict.fromkeys(frame["planes"], pixels)
    image = {name: aligned(size) for name, size in planes.items()}
    out = binding.Outputs(**{name: at for name, (_, at) in image.items()})
    state, error = ctypes.c_void_p(), binding.Error()
    keep = ctypes.byref(state) if frame["wants"] else None
    status = calls.fragprune_forward(
        ctypes.byref(given), ctypes.byref(out), keep, ctypes.byref(error)
    )
    assert status == 0, error.message
    if frame["wants"]:
        loss = (ctypes.c_float * (3 * pixels))(*[0.5] * (3 * pixels))
        sizes = lengths | {"hook": 3 * n}
        grads = {name: (ctypes.c_float * sizes[name])() for name in frame["wants"]}
        by = binding.OutputGrads(image=address(loss))
        to = binding.InputGrads(**{name: address(array) for name, array in grads.items()})
        status = calls.fragprune_backward(
            state, ctypes.byref(by), ctypes.byref(to), 1, ctypes.byref(error)
        )
        assert status == 0, error.message
    sys.stdout.write(f"{out.evaluated / pixels} {out.drawn / pixels}\n")


def aligned(numbers: int) -> tuple[Any, int]:
    """Memory for floats and its address, on a line of the caches as the engine's own is."""
    memory = ctypes.create_string_buffer(4 * numbers + 64)
    return memory, -(-ctypes.addressof(memory) // 64) * 64


GRADIENTS = {
    "forward": (),
    "opacity": ("opacities",),
    "all": ("means", "hook", "opacities", "scales", "rotations", "sh"),
}


def main() -> None:
    """Count and print."""
    import torch

    from fragprune_plugins.bench.scene import make_scene, make_view
    from fragprune_plugins.datasets.cameras import load_cameras
    from fragprune_plugins.storage.ply import read_ply
    from fragprune_plugins.types import RasterInputs

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, action="append")
    parser.add_argument("--gaussians", type=int, default=10_000)
    parser.add_argument("--falloff", type=float, default=16 / 255)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--cameras", type=Path)
    parser.add_argument("--library", default="")
    parser.add_argument("--planes", nargs="*", default=None)
    parser.add_argument("--passes", nargs="*", default=list(GRADIENTS))
    chosen = parser.parse_args()
    splats = (read_ply(chosen.model) if chosen.model else make_scene(chosen.gaussians)).splats()
    for size in chosen.size or [256, 1024]:
        view = load_cameras(chosen.cameras)[0][1] if chosen.cameras else make_view(size, size)
        for falloff in (0.0, chosen.falloff):
            inputs = RasterInputs(view, splats)
            if chosen.planes is not None and hasattr(inputs, "planes"):
                from dataclasses import replace
                inputs = replace(inputs, planes=tuple(chosen.planes))
            tau = torch.full((len(splats),), falloff) if falloff else None
            for name in chosen.passes:
                wants = GRADIENTS[name]
                if wants and tau is not None:
                    wants = (*wants, "thresholds")
                found = counts(inputs, tau, wants=wants, library=chosen.library)
                row = f"{size:5d} {falloff:.3f} {name:8s}"
                for key, value in found.items():
                    row += f" {key} {value:.2f}" if value < 1e4 else f" {key} {value / 1e6:.2f}M"
                print(row, flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--replay"]:
        replay(sys.argv[2])
    else:
        main()
