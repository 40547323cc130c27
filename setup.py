"""Builds the cpu engine once per instruction set; all else about the project is in pyproject.toml.

The loader opens the best build that the machine runs. Each is a plain shared library behind a C
interface, opened with ctypes: neither Python nor torch headers. So the compiler is called as it is,
without the flags that this Python was built with; the libraries' names and the wheel's name no
Python version: one wheel per platform serves all of them. A build that fails (no compiler) is
skipped, and `fragprune doctor` says so.

`CXX` names another compiler, and `CXXFLAGS`, `LDFLAGS` and `ARCHFLAGS` are passed on. To build for
another platform, set `CXX` and `_PYTHON_HOST_PLATFORM`, the platform that Python's own tools then
write into the wheel's name.
"""

import os
import re
import shlex
import shutil
from pathlib import Path
from sysconfig import get_platform

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

# On Windows clang alone: MSVC has no vector types, and GCC does not align the stack for AVX there.
COMPILERS = ["clang++"] if os.name == "nt" else ["c++", "g++", "clang++"]
VARIABLES = ["CXX", "CXXFLAGS", "LDFLAGS", "ARCHFLAGS"]
SUFFIX = ".pyd" if os.name == "nt" else ".so"
LINK = ["-shared", "-static"] if os.name == "nt" else ["-shared", "-fPIC"]
LINKED_TO_FILE = re.compile(r"(?<!!)\[([^\[\]]+)\]\((?!https?:)[^)]+\)")
PICTURE = re.compile(r"!\[[^]]*\]\((?!https?:)[^)]+\)\n+")


def builds(platform: str) -> list[str]:
    """What is built for a platform, in the words of its wheel's name: wide vectors are x86's."""
    return list(BUILDS) if platform.endswith(("x86_64", "amd64")) else ["baseline"]


def description() -> str:
    """README for a package index, which has no files beside it: links to files become words."""
    text = Path("README.md").read_text(encoding="utf-8")
    return LINKED_TO_FILE.sub(r"\1", PICTURE.sub("", text))


if __name__ == "__main__":
    from setuptools import Extension, setup
    from setuptools.command.bdist_wheel import bdist_wheel
    from setuptools.command.build_ext import build_ext
    from setuptools.errors import ExecError
    from setuptools.modified import newer_group

    class Libraries(build_ext):
        """Builds files named as the loader opens them, side by side."""

        def initialize_options(self) -> None:
            """As many at once as there are cores."""
            super().initialize_options()
            self.parallel = True

        def get_ext_filename(self, fullname: str) -> str:
            """Where a library goes, without the tag of this Python."""
            return str(Path(*fullname.split("."))) + SUFFIX

        def build_extension(self, ext: Extension) -> None:
            """One call of the compiler, unless the library is newer than its sources."""
            made = Path(self.get_ext_fullpath(ext.name))
            if not (self.force or newer_group([*ext.sources, *ext.depends], str(made))):
                return
            lanes, flags = BUILDS[ext.name.rpartition("_cpu_")[2]]
            given = {name: shlex.split(os.environ.get(name, "")) for name in VARIABLES}
            compiler = given["CXX"] or list(filter(shutil.which, COMPILERS))[:1]
            if not compiler:
                raise ExecError(f"no C++17 compiler: none of {', '.join(COMPILERS)}")
            made.parent.mkdir(parents=True, exist_ok=True)
            command = [*compiler, *flags, f"-DFP_LANES={lanes}", *given["CXXFLAGS"], *LINK]
            command += [*given["ARCHFLAGS"], *ext.sources, *given["LDFLAGS"], "-o", str(made)]
            self.spawn(command)

    class Wheel(bdist_wheel):
        """Fits every Python 3 of its platform."""

        def get_tag(self) -> tuple[str, str, str]:
            """Python, interface, platform."""
            return "py3", "none", super().get_tag()[2]

    modules = [
        Extension(
            f"fragprune_plugins.native._cpu_{name}",
            [str(SOURCE)],
            depends=list(map(str, HEADERS)),
            optional=True,
        )
        for name in builds(get_platform())
    ]
    setup(
        ext_modules=modules,
        cmdclass={"build_ext": Libraries, "bdist_wheel": Wheel},
        long_description=description(),
        long_description_content_type="text/markdown",
    )
