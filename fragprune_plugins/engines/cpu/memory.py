"""Memory that a step frees, for the next step to use again."""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -3, -4  # of <malloc.h>
_LARGEST = 32 << 20  # bytes; glibc takes no more as the second
_KEPT = 1 << 30


def keep_freed_memory(*, growing: bool = False) -> bool:
    """Let glibc's malloc keep what was freed; say whether it will.

    A step of learning frees gradients as large as the model, and malloc would hand them back to the
    kernel, which clears each page before the next step gets it again. For programs of ours alone:
    it holds for the whole process.

    Args:
        growing: the model grows. Larger arrays do not fit where the last ones were, so blocks of
            more than 32 MiB are handed back, and 1 GiB at most is kept.
    """
    if sys.platform != "linux":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # another C library
        return False
    if growing:
        return bool(mallopt(_MMAP_THRESHOLD, _LARGEST)) and bool(mallopt(_TRIM_THRESHOLD, _KEPT))
    return bool(mallopt(_MMAP_MAX, 0)) and bool(mallopt(_TRIM_THRESHOLD, -1))
