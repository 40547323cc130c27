"""Instructions of the AVX2 build, counted by valgrind: the same number in every run.

    python tests/native/counting.py [--size 256 --size 2048] [--gaussians 10000] [--falloff 0.12]
    python tests/native/counting.py --model point_cloud.ply --cameras cameras.json

Prints, for one thread, millions of instructions by stage, and the fragments evaluated and drawn
per pixel: without truncation and with every Gaussian cut at the falloff. A time says how busy the
machine was as well; a count does not. `--library FILE` counts another build, an older one perhaps.
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

from fragprune_plugins.engines.cpu import binding

STAGES = {
    "project": "fp::project_all(",
    "list": "fp::list_cells(",
    "blend": "fp::(anonymous namespace)::draw(",
    "forward": "fp::(anonymous namespace)::forward(",
    "backward": "fp::(anonymous namespace)::backward(",
}
"""How the functions begin that are the stages: FP_STAGE in the source."""

WANTS = {
    "forward": (),
    "opacity": ("opacities",),
    "all": ("means", "hook", "opacities", "scales", "rotations", "sh"),
}
"""Gradients by the name of a pass; with thresholds theirs are wanted, too."""


def counts(inputs, thresholds, *, kind="forward", library=None):
    """Instructions by stage of one frame, calls included; and `evaluated` and `drawn` per pixel.

    ``kind`` is one of ``WANTS``; the build is this installation's for AVX2 unless one is given.
    """
    from fragprune_plugins.engines.calling import native_arrays, native_inputs

    wants = WANTS[kind]
    if wants and thresholds is not None:
        wants = (*wants, "thresholds")
    arrays = native_arrays(inputs, thresholds)
    given = native_inputs(inputs, arrays, widen="thresholds" in wants)
    plain = (ctypes.c_int32, ctypes.c_int64, ctypes.c_float)
    frame = {
        "library": str(Path(library or binding.open_build("avx2").path).resolve()),
        "scalars": {n: getattr(given, n) for n, kind, *_ in given._fields_ if kind in plain},
        "arrays": {name: array.numpy().tobytes() for name, array in arrays.items()},
        "planes": inputs.planes,
        "wants": wants,
    }
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "frame").write_bytes(pickle.dumps(frame))
        command = ["valgrind", "--tool=callgrind", "--callgrind-out-file=costs", sys.executable]
        command += ["-I", str(Path(__file__).resolve()), "--replay", "frame"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-4000:]
        found = inclusive(Path(folder, "costs").read_text())
    stages: dict[str, float] = {
        name: sum(n for f, n in found.items() if f.startswith(begin) and "{lambda" not in f)
        for name, begin in STAGES.items()
    }
    evaluated, drawn = map(float, done.stdout.split())
    return stages | {"evaluated": evaluated, "drawn": drawn}


def inclusive(costs: str) -> dict[str, int]:
    """Instructions of each function and all that it calls, from callgrind's file."""
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


def replay(path: Path) -> None:
    """Draw a frame that ``counts`` wrote, by ctypes alone: torch under valgrind takes minutes."""
    frame = pickle.loads(path.read_bytes())
    calls, address = ctypes.CDLL(frame["library"]), ctypes.addressof
    arrays = {k: ctypes.create_string_buffer(v, len(v)) for k, v in frame["arrays"].items()}
    lengths = {name: len(raw) // 4 for name, raw in frame["arrays"].items()}
    scalars = frame["scalars"]
    n, pixels = scalars["count"], scalars["width"] * scalars["height"]
    given = binding.Inputs(
        **scalars,
        lengths=binding.Lengths(**lengths),
        **{name: address(raw) for name, raw in arrays.items()},
    )
    sizes = {"image": 3 * pixels, "radii": n} | dict.fromkeys(frame["planes"], pixels)
    memory = {name: ctypes.create_string_buffer(4 * size + 64) for name, size in sizes.items()}
    lines = {name: -(-address(raw) // 64) * 64 for name, raw in memory.items()}  # as the engine's
    out = binding.Outputs(**lines)
    state, error = ctypes.c_void_p(), binding.Error()
    kept = ctypes.byref(state) if frame["wants"] else None
    status = calls.fragprune_forward(
        ctypes.byref(given), ctypes.byref(out), kept, ctypes.byref(error)
    )
    assert status == binding.OK, error.message
    if frame["wants"]:
        loss = (ctypes.c_float * (3 * pixels))(*[0.5] * (3 * pixels))
        lengths["hook"] = 3 * n
        grads = {name: (ctypes.c_float * lengths[name])() for name in frame["wants"]}
        by = binding.OutputGrads(image=address(loss))
        to = binding.InputGrads(**{name: address(array) for name, array in grads.items()})
        status = calls.fragprune_backward(
            state, ctypes.byref(by), ctypes.byref(to), 1, ctypes.byref(error)
        )
        assert status == binding.OK, error.message
    sys.stdout.write(f"{out.evaluated / pixels} {out.drawn / pixels}\n")


def scene(size, gaussians, falloff=0.0, planes=(), scale=1.5):
    """The bench scene on a square picture, and one threshold for all; none at 0.

    At a scale of 1.5, 10,000 Gaussians draw over 20 fragments per pixel.
    """
    import torch

    from fragprune_plugins.types import RasterInputs
    from fragprune_plugins.workbench.bench.scene import make_scene, make_view

    splats, view = make_scene(gaussians).splats(), make_view(size, size)
    thresholds = torch.full((gaussians,), falloff) if falloff else None
    return RasterInputs(view, splats, scale_modifier=scale, planes=planes), thresholds


def main() -> None:
    import torch

    from fragprune_plugins.files.ply import read_ply
    from fragprune_plugins.types import RasterInputs
    from fragprune_plugins.workbench.scenes.cameras import load_cameras

    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--size", type=int, action="append")
    parser.add_argument("--gaussians", type=int, default=10_000)
    parser.add_argument("--falloff", type=float, default=0.12)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--cameras", type=Path)
    parser.add_argument("--library", type=Path)
    parser.add_argument("--planes", nargs="*", default=[], choices=["invdepth", "alpha"])
    parser.add_argument("--kind", action="append", choices=list(WANTS))
    chosen = parser.parse_args()
    for size in chosen.size or [256, 1024]:
        for falloff in (0.0, chosen.falloff):
            planes = tuple(chosen.planes)
            inputs, thresholds = scene(size, chosen.gaussians, falloff, planes)
            if chosen.model is not None:
                splats, (_, view) = read_ply(chosen.model).splats(), load_cameras(chosen.cameras)[0]
                inputs = RasterInputs(view, splats, planes=planes)
                thresholds = torch.full((len(splats),), falloff) if falloff else None
            for kind in chosen.kind or WANTS:
                found = counts(inputs, thresholds, kind=kind, library=chosen.library)
                stages = "  ".join(f"{k} {found[k] / 1e6:.2f}" for k in STAGES)
                pairs = "  ".join(f"{k} {found[k]:.2f}" for k in ("evaluated", "drawn"))
                width, height = inputs.view.width, inputs.view.height
                sys.stdout.write(f"{width}x{height} {falloff:.2f} {kind}  {stages}  {pairs}\n")
                sys.stdout.flush()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--replay"]:
        replay(Path(sys.argv[2]))
    else:
        main()
