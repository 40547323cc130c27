"""Has a host's own rasterizer proved before anything is trained, and keeps what was proved.

The import name of a rasterizer proves nothing. So the first call of each shape, at each place, is
drawn by the host's rasterizer and by our engine, and the dialect's prover compares the two.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import sys
from contextlib import suppress
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fragprune_plugins.constants import VERSION
from fragprune_plugins.engines.cuda.kernels import cache_folder, digest_of_sources
from fragprune_plugins.errors import EngineError, InputError, OutputError, ProofError, log
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.hosts.dialect import HostCall, Place, Proof, Prover
from fragprune_plugins.hosts.seams import SeamCall
from fragprune_plugins.hosts.source import nodes, parsed

if TYPE_CHECKING:
    from fragprune_plugins.injection.state import SessionState

_ENDINGS = (".py", ".so", ".pyd", ".cu", ".cuh", ".cpp", ".h")


def proved(
    session: SessionState, prover: Prover, call: SeamCall, drawn: HostCall, *, strict: bool
) -> Proof | None:
    """The proof of a call of the host's own rasterizer, made now if there is none yet.

    None where it failed and may fail (not ``strict``), and where our engines draw no such call.

    Raises:
        ProofError: it draws otherwise, or returns something that the host uses and we do not know.
    """
    place, joint = _place(session), session.learn and not session.freeze
    drawn = replace(drawn, still=not joint)
    shape = (str(call.seam), place, joint, *prover.shape(drawn))
    if shape not in session.proofs:
        proof = None
        try:
            proof = _read_or_prove(session, prover, call, drawn, shape)
        except ProofError as error:
            if strict and not (prover.otherwise or session.trust):
                raise
            known = f"{error.found}; as known: {prover.otherwise}"
            log.warning("%s", f"not proved: {known}" if prover.otherwise else error)
        except (EngineError, InputError) as error:  # raised again where ours has to draw
            log.info("not proved: %s", error)
        session.proofs[shape] = proof  # only now: a host may live on after another exception
    return session.proofs[shape]


def _read_or_prove(
    session: SessionState, prover: Prover, call: SeamCall, drawn: HostCall, shape: tuple[Any, ...]
) -> Proof:
    """A kept proof of a call of this shape, else a new one, which is kept if it fails, too."""
    means = drawn[session.dialect.means]
    engine = session.engine(means.device)
    processor = session.processor(means.device)
    known = (VERSION, digest_of_sources(), session.adapter.name, engine.name, processor, shape)
    key = hashlib.sha256(repr(known).encode()).hexdigest()[:16]
    file = sys.modules[call.seam.module].__file__
    kept = file_of(digest_of(Path(file)), key) if file else None
    proof = read(kept) if kept else None
    expected = f"what {session.adapter.name} draws, forward and backward"
    if proof is None:
        try:
            proof = prover.prove(call, replace(drawn, engine=engine), shape[1])
        except RuntimeError as error:
            if type(error).__name__ != "OutOfMemoryError":  # torch's: check needs none of torch
                raise
            found = f"no room on the GPU to draw it both ways ({str(error).partition('. GPU')[0]})"
            remedy = "Free memory of the GPU. With --trust nobody compares."
            raise ProofError(str(call.seam), found, expected, remedy) from error
        if kept:
            keep(proof, kept)
    if proof.failed:
        remedy = "Thresholds would learn from other pictures than its own. fragprune check says "
        remedy += "whether its PLY is plain 3DGS, which fragprune finetune prunes; --stage off "
        remedy += "trains without thresholds, and --trust with them all the same."
        raise ProofError(proof.call, proof.failed, expected, remedy)
    log.info("proved: %s", proof)
    return proof


# ---- the place of a call -----------------------------------------------------------------------


def _place(session: SessionState) -> Place:
    """The innermost place in the host's own files that this call comes from."""
    root = session.repo.root
    inside, frame = f"{root / session.repo.package}{os.sep}", sys._getframe(1)
    while frame.f_back is not None:
        file = frame.f_code.co_filename
        if file.startswith(inside) and "site-packages" not in file[len(inside) :]:
            at = f"{frame.f_code.co_name} ({os.path.relpath(file, root)}:{frame.f_lineno})"
            return _read_place(Path(file), frame.f_lineno, at)
        frame = frame.f_back
    return Place("a call from outside the host")


@cache
def _read_place(file: Path, line: int, at: str) -> Place:
    around: dict[type, Any] = {}  # the innermost of each kind, because it is walked to last
    for node in nodes(parsed(file.read_text(errors="replace"))):
        if getattr(node, "lineno", line + 1) <= line <= (getattr(node, "end_lineno", 0) or 0):
            around[type(node)] = node
    assigned, function = around.get(ast.Assign), around.get(ast.FunctionDef)
    target = assigned.targets[0] if assigned else None
    if function is None or not isinstance(target, ast.Tuple):
        return Place(at)
    names = tuple(ast.unparse(each) for each in target.elts)
    used = (node for node in nodes(function) if isinstance(node, ast.Name))
    read = {node.id for node in used if isinstance(node.ctx, ast.Load)}
    unread = {k for k, name in enumerate(names) if name.isidentifier() and name not in read}
    return Place(at, names, frozenset(unread))


# ---- kept proofs -------------------------------------------------------------------------------


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
    with suppress(OutputError), replacing(file) as target:
        target.write_text(json.dumps(asdict(proof)))


def read(file: Path) -> Proof | None:
    """A kept proof; None without one."""
    with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
        told: dict[str, Any] = json.loads(file.read_text())
        made = {int(number): name for number, name in told["made"].items()}
        return Proof(told["call"], tuple(told["outputs"]), made, told["failed"])
    return None
