"""Keeps proofs: what a host's own rasterizer was seen to draw, by a digest of its files."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from fragprune_plugins.engines.cuda.kernels import cache_folder
from fragprune_plugins.files.atomic import replacing

_ENDINGS = (".py", ".so", ".pyd", ".cu", ".cuh", ".cpp", ".h")


@dataclass(frozen=True)
class Proof:
    """A call of a host's rasterizer that was drawn by both, the same way or not.

    Attributes:
        call: the rasterizer, and the place of the call in the host's source.
        outputs: what each returned value is, in order.
        made: by the number of an output, its meaning (``likeness.MEANINGS``), where the proof found
            another than the adapter answers.
        failed: how it draws otherwise; "" if it does not.
    """

    call: str
    outputs: tuple[str, ...]
    made: dict[int, str] = field(default_factory=dict)
    failed: str = ""

    def __str__(self) -> str:
        returned = f"returns {', '.join(self.outputs)}"
        return f"{self.call}: {self.failed}" if self.failed else f"{self.call} {returned}"


def digest_of(file: Path) -> str:
    """A digest of a rasterizer's files: of its package's folder, or of a module that is alone."""
    own = file.parent.rglob("*") if file.name == "__init__.py" else [file]
    files = sorted(path for path in own if path.suffix in _ENDINGS)
    return _digest(tuple((path, path.stat().st_mtime_ns, path.stat().st_size) for path in files))


@cache
def _digest(files: tuple[tuple[Path, int, int], ...]) -> str:
    digest = hashlib.sha256()
    for path, *_ in files:
        digest.update(f"{path.name}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def file_of(rasterizer: str, call: str) -> Path:
    """Where a proof is kept, by the digests of rasterizer and call."""
    return cache_folder() / "proofs" / f"{rasterizer}-{call}.json"


def keep(proof: Proof, file: Path) -> None:
    """Keep a proof for later runs on this machine. A folder that cannot be written keeps none."""
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as target:
            target.write_text(json.dumps(asdict(proof)))


def read(file: Path) -> Proof | None:
    """A kept proof; None without one."""
    with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
        told: dict[str, Any] = json.loads(file.read_text())
        made = {int(number): name for number, name in told["made"].items()}
        return Proof(told["call"], tuple(told["outputs"]), made, told["failed"])
    return None
