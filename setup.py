"""Builds the cpu engine once per instruction set; all else about the project is in pyproject.toml.

The loader opens the best build that the machine runs. Each is a plain shared library behind a C
interface, opened with ctypes: neither Python nor torch headers. So their names and the wheel's name
no Python version: one wheel per platform serves all of them. A build that fails (no compiler,
another architecture) is skipped, and `fragprune doctor` says so.
"""

import os
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

SUFFIX = ".pyd" if os.name == "nt" else ".so"

if __name__ == "__main__":
    from setuptools import Extension, setup
    from setuptools.command.bdist_wheel import bdist_wheel
    from setuptools.command.build_ext import build_ext

    class Libraries(build_ext):
        """Builds files named as the loader opens them."""

        def get_ext_filename(self, fullname: str) -> str:
            """Where a library goes, without the tag of this Python."""
            return str(Path(*fullname.split("."))) + SUFFIX

    class Wheel(bdist_wheel):
        """Fits every Python 3 of its platform."""

        def get_tag(self) -> tuple[str, str, str]:
            """Python, interface, platform."""
            return "py3", "none", super().get_tag()[2]

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
    setup(ext_modules=modules, cmdclass={"build_ext": Libraries, "bdist_wheel": Wheel})
