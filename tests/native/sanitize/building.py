"""Compiles the engine's source with sanitizers, together with a C++ program of the tests."""

import os
import runpy
import shlex
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from fragprune_plugins.engines.cpu import binding

ROOT = Path(__file__).parents[3]
TESTS = ROOT / "tests" / "native"
PLAIN = ("-O1", "-g1", "-fno-omit-frame-pointer")
MEMORY = ("-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
"""Reads and writes out of bounds, leaks, and arithmetic that C++ leaves undefined."""

THREADS = ("-fsanitize=thread",)
"""Races between threads."""

ENVIRONMENT = {
    "ASAN_OPTIONS": "detect_leaks=1:allocator_may_return_null=1",
    "UBSAN_OPTIONS": "print_stacktrace=1",
    "TSAN_OPTIONS": "halt_on_error=1",
}


def builds() -> list[str]:
    """The instruction sets that this machine runs."""
    features = binding.cpu_features()
    return [name for name, needs in binding.BUILDS.items() if needs & ~features == 0]


def shipped_flags(build: str) -> tuple[str, list[str]]:
    """Source and compiler flags of a build as setup.py has them."""
    shipped = runpy.run_path(str(ROOT / "setup.py"))
    lanes, flags = shipped["BUILDS"][build]
    kept = [flag for flag in flags if not flag.startswith("-O")]
    return str(ROOT / shipped["SOURCE"]), [*kept, f"-DFP_LANES={lanes}"]


@dataclass
class Toolchain:
    """A compiler with its first arguments, a folder for programs, and flags of everything."""

    compiler: list[str]
    folder: Path
    plain: Sequence[str] = PLAIN

    def program(self, source: str, build: str, sanitizers: tuple[str, ...]) -> Path:
        """One of the tests' programs with the engine, compiled once."""
        engine, flags = shipped_flags(build)
        made = self.folder / "-".join([Path(source).stem, build, *sanitizers])
        if not made.exists():
            include = ROOT / "fragprune_plugins/native/include"
            command = [*self.compiler, *flags, *self.plain, *sanitizers, engine, TESTS / source]
            command += [f"-I{include}", f"-I{TESTS / 'sanitize'}", "-pthread", "-o", made]
            done = subprocess.run(command, capture_output=True, text=True, timeout=240)
            assert done.returncode == 0, done.stderr[-4000:]
        return made

    def tally(self, source, build, sanitizers, *words):
        """What such a program prints in the end; skips where none with these sanitizers runs."""
        before = wrapper(self, sanitizers)
        program = self.program(source, build, sanitizers)
        return run([*before, str(program), *map(str, words)], self.folder)


def find_compiler() -> list[str] | None:
    """What ``CXX`` names, or the usual ones."""
    for name in (os.environ.get("CXX", ""), "c++", "g++", "clang++"):
        words = shlex.split(name)
        if words and shutil.which(words[0]):
            return words
    return None


def wrapper(toolchain: Toolchain, sanitizers: tuple[str, ...]) -> list[str]:
    """What must precede a sanitized program here; skips the test where none runs at all.

    An older thread sanitizer dies where a new kernel spreads addresses too widely; setarch -R
    makes it place them as before.
    """
    source = toolchain.folder / "nothing.cpp"
    source.write_text("int main() {}\n")
    made = toolchain.folder / "nothing"
    command = [*toolchain.compiler, *sanitizers, "-pthread", str(source), "-o", str(made)]
    built = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if built.returncode:
        pytest.skip(f"{toolchain.compiler[0]} has no {sanitizers[0]}: {built.stderr[-200:]}")
    said = ""
    for before in ([], ["setarch", "-R"]):
        if before and not shutil.which(before[0]):
            continue
        ran = subprocess.run([*before, str(made)], capture_output=True, text=True, timeout=60)
        if ran.returncode == 0:
            return before
        said = ran.stderr[-200:]
    pytest.skip(f"programs with {sanitizers[0]} do not run here: {said}")


def run(command: list[str], folder: Path) -> dict[str, int]:
    """Run a program of ours and read the tally it prints."""
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=240,
        cwd=folder,
        env={**os.environ, **ENVIRONMENT},
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-6000:]
    words = done.stdout.split()
    return dict(zip(words[::2], map(int, words[1::2]), strict=True))
