"""How much faster the cpu engine is than the reference: forward and backward, every gradient.

    python tests/native/bench_against_oracle.py [--gaussians 5000] [--width 160] [--height 90]

Prints the medians and their ratio; not a test, times depend on the machine and on its other work.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time

import torch

from fragprune_plugins.engines import create_engine
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.testing import scenes


def seconds(name: str, gaussians: int, width: int, height: int, runs: int) -> float:
    """Median of one forward and backward pass after a first that is not counted."""
    engine = create_engine(name)
    scene = scenes.random_scene(0, gaussians, width, height, sh_degree=3, scale_modifier=0.5)
    inputs, _ = scenes.leaves(scene)
    thresholds = scenes.random_thresholds(0, gaussians).requires_grad_()
    times = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        out = engine.rasterize(inputs, thresholds)
        (out.image.square().sum() + out.fragments_per_pixel).backward()
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:])


def main() -> None:
    """Measure and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gaussians", type=int, default=5000)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--height", type=int, default=90)
    options = vars(parser.parse_args())
    slow = seconds("reference", **options, runs=3)
    fast = seconds("cpu", **options, runs=15)
    report = {
        "build": binding.describe()["build"],
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
        "reference_ms": round(slow * 1e3, 1),
        "cpu_ms": round(fast * 1e3, 2),
        "ratio": round(slow / fast, 1),
    }
    sys.stdout.write(json.dumps(report) + "\n")


if __name__ == "__main__":
    main()
