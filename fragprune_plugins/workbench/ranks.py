"""Several processes that learn one model together, as ``torchrun`` starts them: its ranks.

Each holds a replica of the whole model and draws its share of every step's views. The gradients are
summed over all of them, and each takes the same optimizer step, so replicas stay equal to the bit.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, Any, TypeVar

from fragprune_plugins.errors import RanksError

if TYPE_CHECKING:
    import torch

Each = TypeVar("Each")
OLDEST = "2.5"  # release of torch with which several processes were tried
PATIENCE = 600.0  # seconds to wait for the other processes before this one ends with an error
_PIECE = 1 << 22  # numbers of a tensor that are summed at once


@dataclass(frozen=True)
class Ranks:
    """All processes of one learning, seen from one of them; by default there is one.

    What they do together raises RanksError if another process is gone.
    """

    rank: int = 0  # of this process
    size: int = 1

    @property
    def first(self) -> bool:
        """Whether this process prints, and writes files."""
        return self.rank == 0

    @property
    def several(self) -> bool:
        """Whether there are others."""
        return self.size > 1

    def share(self, views: Sequence[Each]) -> Sequence[Each]:
        """The views of a step that this process draws."""
        return views[self.rank :: self.size]

    def sum(self, tensor: torch.Tensor) -> None:
        """Add up a tensor over all processes, in place; each gets the same bits."""
        if self.several:
            with self._together() as dist:
                dist.all_reduce(tensor)

    def exchange(self, rows: torch.Tensor, to: list[int], by: list[int]) -> torch.Tensor:
        """Send rows (M, ...), ``to`` so many each process, and receive ``by`` so many, by rank."""
        if not self.several:
            return rows
        received = rows.new_empty(sum(by), *rows.shape[1:])
        with self._together() as dist:
            dist.all_to_all_single(received, rows.contiguous(), by, to)
        return received

    def gather(self, value: Any) -> list[Any]:
        """A plain value of each process, by rank."""
        if not self.several:
            return [value]
        values: list[Any] = [None] * self.size
        with self._together() as dist:
            dist.all_gather_object(values, value)
        return values

    def agree(self, what: Mapping[str, Any], where: str) -> None:
        """Raise RanksError, in every process, unless all have the same values by the same names."""
        known = self.gather(dict(what))
        for rank, other in enumerate(known):
            names = known[0].keys() | other.keys()
            if differ := sorted(n for n in names if known[0].get(n) != other.get(n)):
                raise RanksError(
                    where,
                    f"process {rank} of {self.size} with other {', '.join(differ)} than process 0",
                    "processes that are equal to the bit",
                    "Nothing of it was saved. Start all with the same command, versions, files and "
                    "kind of processor or GPU; --out must be in a folder that all of them see.",
                )

    @contextlib.contextmanager
    def _together(self) -> Iterator[Any]:
        """torch's collective operations; what one raises is stated."""
        import torch.distributed as dist

        try:
            yield dist
        except RuntimeError as error:  # of gloo, NCCL or the store; each has words of its own
            said = re.sub(r"^\[.*?\] ", "", str(error).strip()).split(". ")[0][:200]
            raise RanksError(
                f"process {self.rank} of {self.size}",
                f"another process ended, or gave no answer for {PATIENCE:g} s ({said})",
                "all processes, to the end of learning",
                "Nothing of this step was saved. Look for the process that ended first; the same "
                "command goes on from the last checkpoint, if there is one.",
            ) from error


def launched() -> Ranks:
    """What a launcher such as ``torchrun`` says in the environment."""
    size = _told("WORLD_SIZE")
    return Ranks(_told("RANK"), size) if size > 1 else Ranks()


def local_rank() -> int:
    """The number of this process among those of its machine: which GPU it takes."""
    return _told("LOCAL_RANK")


def _told(name: str) -> int:
    said = os.environ.get(name, "")
    return int(said) if said.isdigit() else 0


@contextlib.contextmanager
def joined(device: torch.device) -> Iterator[Ranks]:
    """Inside, the processes that were launched together can exchange tensors of a device.

    RanksError if they do not find each other, or torch is too old.
    """
    ranks = launched()
    if not ranks.several:
        yield ranks
        return
    import torch
    import torch.distributed as dist

    if torch.__version__ < OLDEST:  # 2.0 waits without end when the processes part
        remedy = f"Learn in one process, or with torch {OLDEST}."
        raise RanksError("learning", f"torch {torch.__version__}", f"{OLDEST} or newer", remedy)

    # Its functions have the group as a default, of the time of their import: imported later, as by
    # an optimizer, they would keep the group and its threads alive until Python is gone, and a
    # thread that then frees a tensor aborts the process.
    importlib.import_module("torch.distributed.nn.functional")
    if device.type == "cuda":
        torch.cuda.set_device(device)
    try:
        backend = "cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo"
        dist.init_process_group(backend, timeout=timedelta(seconds=PATIENCE))
    except (RuntimeError, ValueError) as error:
        raise RanksError(
            "learning",
            f"{ranks.size} processes that do not find each other ({str(error)[:200]})",
            "the environment that torchrun sets",
            "Start them with torchrun --nproc_per_node 2 -m fragprune_plugins finetune ... "
            "To learn in this process alone, unset WORLD_SIZE.",
        ) from error
    try:
        yield ranks
    except BaseException:
        should_print()  # before the others notice that this process is gone
        raise
    finally:
        dist.destroy_process_group()


def should_print() -> bool:
    """Whether this process is the first of all that asks: it says why they end, and others do not.

    Without a launcher whose store outlives its processes everyone speaks.
    """
    if not launched().several or os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True":
        return True
    asked = ("MASTER_ADDR", "MASTER_PORT", "TORCHELASTIC_RESTART_COUNT")
    return _asks_first(*(os.environ.get(name, "0") for name in asked))


@functools.cache
def _asks_first(address: str, port: str, attempt: str) -> bool:
    from torch.distributed import TCPStore  # type: ignore[attr-defined]

    try:
        store = TCPStore(address, int(port), is_master=False, timeout=timedelta(seconds=5))
        return int(store.add(f"fragprune-said-{attempt}", 1)) == 1
    except (RuntimeError, ValueError):
        return True


def fingerprint(tensor: torch.Tensor) -> int:
    """A number that is another one if any bit of a float32 tensor is another one, or moves."""
    import torch

    bits = tensor.detach().contiguous().view(torch.int32).reshape(-1)
    places = torch.arange(1, min(len(bits), _PIECE) + 1, device=bits.device)
    total = 0
    for start in range(0, len(bits), _PIECE):
        piece = bits[start : start + _PIECE]
        total = 31 * total + int((piece * places[: len(piece)]).sum())  # int64, modulo 2**64
    return total % 2**64
