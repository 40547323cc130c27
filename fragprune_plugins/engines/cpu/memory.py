"""Memory that a step frees, for the next step to use again."""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of <malloc.h>
_LARGEST = 32 << 20  # bytes; glibc takes no more as the second
_KEPT = 1 << 30


def keep_freed_memory() -> bool:
    """Let glibc's malloc keep up to 1 GiB that was freed; say whether it will.

    A step of learning frees gradients as large as the model, and malloc would hand them back to the
    kernel, which clears each page before the next step gets it again. Blocks of more than 32 MiB
    are handed back all the same. For programs of ours alone: it holds for the whole process.
    """
    if sys.platform != "linux":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # another C library
        return False
    return bool(mallopt(_MMAP_THRESHOLD, _LARGEST)) and bool(mallopt(_TRIM_THRESHOLD, _KEPT))
