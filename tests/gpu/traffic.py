"""What the kernels ask of memory, counted under emulation: sectors, and turns of shared memory.

cd tests && python -m gpu.traffic [--gaussians 100000] [--size 640x480]

Draws the bench scene, whole and with every threshold at 0.05, goes backward, and prints a row for
each kernel: sectors of 32 bytes that it reads, writes and adds to, each once for a block, and as
often as warps ask for them; turns of shared memory, and how many of them conflicts of banks cost;
lanes that take part in a request. Numbers of the whole scene, and those of the cut one over them.
"""

import argparse
import ctypes
import shutil
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gpu.emulated import HERE

from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.bench.scene import make_scene, make_view
from fragprune_plugins.workbench.doctor.emulated import EMULATION, EmulatedDevice

KINDS = ("read", "write", "atomic", "shared")
FIGURES = ("requests", "lanes", "units", "least")
FALLOFF = 0.05


class CountingDevice(EmulatedDevice):
    """Also counts what warps ask of memory.

    Attributes:
        traffic: by kernel, kind and figure. Units are sectors, or turns of shared memory; the least
            are the turns that there would be without conflicts.
    """

    def __init__(self, compiler: str, folder: Path) -> None:
        super().__init__(compiler, folder)
        self.resident = 1
        self.traffic: dict[str, np.ndarray[Any, Any]] = defaultdict(lambda: np.zeros((4, 4), int))

    def launch(self, where: Any, source: str, macros: Any, kernel: str, *further: Any) -> None:
        super().launch(where, source, macros, kernel, *further)
        counts = np.zeros((len(KINDS), len(FIGURES)), np.int64)
        self._open(source, macros).emulated_traffic(counts.ctypes.data_as(ctypes.c_void_p))
        self.traffic[kernel] += counts

    def _compile(self, path: Path, *text: str) -> None:
        seen = path.with_suffix(".o")
        self._build(seen, "-c", "-fsanitize=thread", "-fno-tree-sra", *text)
        parts = (self._part(s) for s in (EMULATION / "emulation.cpp", HERE / "traffic.cpp"))
        self._build(path, "-shared", *parts, str(seen))


def row(traffic: np.ndarray[Any, Any]) -> dict[str, float]:
    requests, lanes, units, least = traffic.T
    return {
        "sectors, once a block": least[:3].sum(),
        "as asked for": units[:3].sum(),
        "turns": units[3],
        "by conflicts": (units - least)[3],
        "lanes": lanes.sum() / max(1, requests.sum()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m gpu.traffic", description=__doc__)
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--size", default="640x480")
    asked = parser.parse_args()
    splats = make_scene(asked.gaussians).splats()
    for each in vars(splats).values():
        if isinstance(each, torch.Tensor):
            each.requires_grad_()
    inputs = RasterInputs(make_view(*map(int, asked.size.split("x"))), splats, planes=())
    compiler = shutil.which("g++") or parser.error("no g++ here")
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for thresholds in (None, torch.full((len(splats),), FALLOFF)):
            device = CountingDevice(compiler, Path(folder))
            drawn = CudaEngine(device, deterministic=False).rasterize(inputs, thresholds)
            drawn.image.sum().backward()
            found.append({name: row(each) for name, each in device.traffic.items()})
    whole, cut = found
    print("| kernel |", " | ".join(whole["fp_blend"]), "|\n|---" + "|---" * 5 + "|")
    for name, figures in whole.items():
        cells = (f"{v:,.0f} x {cut[name][k] / max(v, 1):.2f}" for k, v in figures.items())
        print(f"| `{name}` |", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
