"""Builds the cpu engine once per instruction set; all else about the project is in pyproject.toml.

The loader opens the best build that the machine runs. Each is a plain shared library behind a C
interface, opened with ctypes: neither Python nor torch headers. A build that fails (no compiler,
another architecture) is skipped, and `fragprune doctor` says so.
"""

from pathlib import Path

NATIVE = Path("fragprune_plugins", "native")
SOURCE = NATIVE / "cpu" / "engine.cpp"
HEADERS = sorted([*NATIVE.glob("include/*.h"), *NATIVE.glob("cpu/*.h")])
FLAGS = ["-std=c++17", "-O3", "-g0", "-fno-math-errno", "-ffp-contract=off"]
FLAGS += ["-fvisibility=hidden", "-pthread"]
AVX512 = [*(f"-mavx512{part}" for part in ("f", "dq", "vl", "bw")), "-mprefer-vector-width=512"]
BUILDS = {  # name: floats in a vector, compiler flags
    "baseline": (4, FLAGS),
    "avx2": (8, [*FLAGS, "-mavx2", "-mfma", "-mbmi", "-mbmi2"]),
    "avx512": (16, [*FLAGS, *AVX512, "-mfma", "-mbmi", "-mbmi2"]),
}

if __name__ == "__main__":
    from setuptools import Extension, setup

    modules = [
        Extension(
            f"fragprune_plugins.native._cpu_{name}",
            [str(SOURCE)],
            define_macros=[("FP_LANES", str(lanes))],
            depends=list(map(str, HEADERS)),
            extra_compile_args=flags,
            optional=True,
        )
        for name, (lanes, flags) in BUILDS.items()
    ]
    setup(ext_modules=modules)
