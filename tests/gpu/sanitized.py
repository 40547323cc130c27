"""Runs the kernels, emulated, under a sanitizer, over random scenes; ends as soon as one complains.

cd tests && python -m gpu.sanitized thread --resident 3 --seeds 100
"""

import argparse
import ctypes
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from unittest import mock

import scenes
import torch
from gpu.emulated import BrokenDevice, Numbers
from native.test_invariants import everything
from spacetime import KINDS, cut, gradients, leaves, moment, splats

from fragprune_plugins.engines.cuda import frame
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.doctor.emulated import EmulatedDevice

SANITIZERS = {
    "thread": (
        ("-fsanitize=thread", "--param=tsan-distinguish-volatile=1"),
        "libtsan.so",
        {"TSAN_OPTIONS": "halt_on_error=1:ignore_noninstrumented_modules=1"},
    ),
    "address": (
        ("-fsanitize=address", "-fsanitize-sections=emulated_shared"),
        "libasan.so",
        {"ASAN_OPTIONS": "detect_leaks=0"},
    ),
    "undefined": (
        ("-fsanitize=undefined,float-cast-overflow", "-fno-sanitize-recover=all"),
        "libubsan.so",
        {"UBSAN_OPTIONS": "print_stacktrace=1"},
    ),
}
"""Flags of the compiler, the library, which comes before all others, and its options."""

DIALECTS = (
    {},
    {"sh_degree": 3, "compensation": "antialiasing", "width": 17, "height": 33},
    {"features": 3, "colors": True, "offsets": True, "absolute_gradient": True},
    {"cov3d": True, "compensation": "mip", "alpha_max": 0.6, "cap_gradient": False, "stop": 0.1},
)


def library(compiler: str, kind: str) -> str | None:
    """A sanitizer's own, where the compiler has one."""
    command = [compiler, f"-print-file-name={SANITIZERS[kind][1]}"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    return said if Path(said).is_file() else None


class GuardedArena(frame.Arena):
    """Has poisoned bytes between its arrays: AddressSanitizer knows the ends of tensors alone."""

    def __init__(self, where, fill, **sizes):
        super().__init__(where, fill, **{k: size + 256 for k, size in sizes.items()})
        poison = getattr(ctypes.CDLL(None), "__asan_poison_memory_region")
        for name, size in sizes.items():
            after = self[name] + size
            end = self[name] + -(-(size + 256) // 256) * 256
            poison(ctypes.c_void_p(after), ctypes.c_size_t(end - after))


def poisoned(inputs: RasterInputs, seed: int) -> RasterInputs:
    """Some numbers are not finite, or far too large."""
    generator = torch.Generator().manual_seed(seed)
    spoiled = {}
    for name in ("means", "opacities", "scales", "rotations", "sh"):
        tensor = getattr(inputs.splats, name)
        if tensor is not None:
            at = torch.randint(tensor.numel(), (3,), generator=generator)
            tensor = tensor.clone()
            tensor.view(-1)[at] = torch.tensor([torch.nan, torch.inf, -1e20])
            spoiled[name] = tensor
    return replace(inputs, splats=replace(inputs.splats, **spoiled))


def draw(device: EmulatedDevice, seed: int) -> None:
    """All kernels, in one of the dialects."""
    device.seed = seed
    inputs = scenes.random_scene(seed, **DIALECTS[seed % len(DIALECTS)])
    thresholds = scenes.random_thresholds(seed, len(inputs.splats))
    for deterministic in (False, True):
        engine = CudaEngine(device, deterministic=deterministic)
        engine.capacity = 1 << 12
        everything(engine, inputs, thresholds)
        everything(engine, scenes.random_scene(seed, 700, 70, 50), None)
        everything(engine, scenes.stack([0.3, 0.9, 0.999, 0.5] * 90), None)
        everything(engine, poisoned(scenes.random_scene(seed, 60, 1, 1), seed), None)
    engine = CudaEngine(device)
    engine.capacity = 7
    engine.rasterize(scenes.random_scene(seed, 300, 330, 290, scale_modifier=3.0), None)
    engine.rasterize(scenes.empty(), None)
    given = leaves(splats(KINDS[seed % len(KINDS)], 300), torch.float32)
    gradients(given, cut(engine, given, moment(1)))


def run_broken(device: EmulatedDevice, kernel: str) -> None:
    """One of the kernels of broken.cu, in three blocks."""
    where = torch.device("cpu")
    arena = frame.Arena(where, torch.zeros, numbers=4 * 3 * 256, others=4 * 256)
    device.launch(where, "broken", {}, kernel, 3, Numbers(to=arena["numbers"]))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m gpu.sanitized", description=__doc__)
    parser.add_argument("kind", choices=SANITIZERS)
    parser.add_argument("--resident", type=int, default=3, help="blocks under way at a time")
    parser.add_argument("--first", type=int, default=0, help="seed")
    parser.add_argument("--seeds", type=int, default=len(DIALECTS))
    parser.add_argument("--broken", help="a kernel of broken.cu instead")
    parser.add_argument("--compiler", default=os.environ.get("CXX", "g++"))
    asked = parser.parse_args()
    flags, _, options = SANITIZERS[asked.kind]
    if "FRAGPRUNE_SANITIZED" not in os.environ:  # again, with the sanitizer loaded first
        preload = library(asked.compiler, asked.kind)
        if preload is None:
            parser.error(f"{asked.compiler} has no sanitizer of {asked.kind}")
        environment = {"LD_PRELOAD": preload, "FRAGPRUNE_SANITIZED": asked.kind, **options}
        command = [sys.executable, "-m", "gpu.sanitized", *sys.argv[1:]]
        os.execve(sys.executable, command, {**os.environ, **environment})
    del os.environ["LD_PRELOAD"]  # the compiler does without
    arena = GuardedArena if asked.kind == "address" else frame.Arena
    with tempfile.TemporaryDirectory() as folder, mock.patch.object(frame, "Arena", arena):
        kind = BrokenDevice if asked.broken else EmulatedDevice
        device = kind(asked.compiler, Path(folder), ("-g1", *flags))
        device.resident = asked.resident
        if asked.broken:
            return run_broken(device, asked.broken)
        for seed in range(asked.first, asked.first + asked.seeds):
            draw(device, seed)
            print("seed", seed, flush=True)


if __name__ == "__main__":
    main()
