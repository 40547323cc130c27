"""Memory that a step frees, for the next step to use again."""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -3, -4  # of <malloc.h>
_OF_ONE_SIZE = {_MMAP_MAX: 0, _TRIM_THRESHOLD: -1}
_GROWING = {_MMAP_MAX: 1 << 16, _MMAP_THRESHOLD: 32 << 20, _TRIM_THRESHOLD: 1 << 30}


def keep_freed_memory(*, growing: bool = False) -> bool:
    """Let glibc's malloc keep what was freed, in the whole process; say whether it will.

    A step of learning frees gradients as large as the model, and malloc would hand them back to the
    kernel, which clears each page before it is used again. Where a model is growing, arrays outgrow
    the room of the last ones: blocks of more than 32 MiB go back, and 1 GiB at most is kept.
    """
    if sys.platform != "linux":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # another C library
        return False
    return all(mallopt(*each) for each in (_GROWING if growing else _OF_ONE_SIZE).items())
