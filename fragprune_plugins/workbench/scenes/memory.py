"""Keeps the pixels of photographs while there is room: a scene may have more than the memory."""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING

from fragprune_plugins.files.reading import MEBIBYTE

if TYPE_CHECKING:
    from torch import Tensor

ROOM = 4096 * MEBIBYTE
"""Bytes of pixels that are kept: 170 photographs of 3840x2160 pixels."""


class Slot:
    """The place of one photograph's pixels, shared by its copies on other devices."""

    def __init__(self) -> None:
        self.pixels: Tensor | None = None
        self.used = 0


class Pictures:
    """Pixels in slots; those that were not used for longest go when the room is full.

    Args:
        room: bytes to keep. One picture is kept, whatever its size.
    """

    def __init__(self, room: int) -> None:
        self.room = room
        self._filled: weakref.WeakSet[Slot] = weakref.WeakSet()
        self._clock = itertools.count(1)

    @property
    def size(self) -> int:
        """Bytes of all pixels that are kept."""
        return sum(_bytes(slot) for slot in self._filled)

    def get(self, slot: Slot, load: Callable[[], Tensor]) -> Tensor:
        """The slot's pixels, loaded if they are not there."""
        slot.used = next(self._clock)
        pixels = slot.pixels
        if pixels is None:
            pixels = slot.pixels = load()
            self._filled.add(slot)
            self._make_room(slot)
        return pixels

    def _make_room(self, newest: Slot) -> None:
        size = self.size
        for slot in sorted(self._filled, key=lambda each: each.used):
            if size <= self.room or slot is newest:
                return
            size -= _bytes(slot)
            slot.pixels = None
            self._filled.discard(slot)


def _bytes(slot: Slot) -> int:
    return 0 if slot.pixels is None else slot.pixels.numel()


PICTURES = Pictures(ROOM)
"""Of the whole process."""
