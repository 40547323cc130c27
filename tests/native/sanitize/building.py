"""Compiles the engine's source with sanitizers, together with a C++ program of the tests."""

import os
import runpy
import shlex
import shutil
import subprocess
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
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
    """A compiler and a folder; each object is compiled once.

    Attributes:
        compiler: the command and its first arguments.
        folder: where objects and programs go.
        plain: flags of everything.
    """

    compiler: list[str]
    folder: Path
    plain: Sequence[str] = PLAIN
    _objects: dict[tuple[str, ...], Future[Path]] = field(default_factory=dict)
    _pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(2))

    def engine(self, build: str, sanitizers: tuple[str, ...]) -> Future[Path]:
        """Start compiling the engine."""
        source, flags = shipped_flags(build)
        return self._object(source, *flags, *sanitizers)

    def program(self, source: str, build: str, sanitizers: tuple[str, ...]) -> Path:
        """Link one of the tests' programs with the engine."""
        include = f"-I{ROOT / 'fragprune_plugins/native/include'}"
        flags = ["-std=c++17", include, f"-I{TESTS / 'sanitize'}"]
        pending = [
            self.engine(build, sanitizers),
            self._object(str(TESTS / source), *flags, *sanitizers),
        ]
        objects = [str(job.result()) for job in pending]
        made = self.folder / f"{Path(source).stem}_{len(list(self.folder.iterdir()))}"
        self._compile(*objects, "-pthread", *sanitizers, "-o", str(made))
        return made

    def _object(self, source: str, *flags: str) -> Future[Path]:
        key = (source, *flags)
        if key not in self._objects:
            made = self.folder / f"{len(self._objects)}.o"
            command = [*flags, "-pthread", "-c", source, "-o", str(made)]
            self._objects[key] = self._pool.submit(self._compile, *command, gives=made)
        return self._objects[key]

    def _compile(self, *arguments: str, gives: Path | None = None) -> Path | None:
        done = subprocess.run(
            [*self.compiler, *self.plain, *arguments], capture_output=True, text=True, timeout=240
        )
        assert done.returncode == 0, done.stderr[-4000:]
        return gives


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
