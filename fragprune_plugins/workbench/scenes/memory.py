"""Keeps the pixels of photographs while there is room: a scene may have more than the memory."""

from __future__ import annotations

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


class Pictures:
    """Pixels in slots; those that were not used for longest go when the room is full.

    Args:
        room: bytes to keep. One picture is kept, whatever its size.
    """

    def __init__(self, room: int) -> None:
        self.room = room
        self._held: weakref.WeakKeyDictionary[Slot, Tensor] = weakref.WeakKeyDictionary()

    @property
    def size(self) -> int:
        """Bytes of all pixels that are kept."""
        return sum(pixels.numel() for pixels in self._held.values())

    def get(self, slot: Slot, load: Callable[[], Tensor]) -> Tensor:
        """The slot's pixels, loaded if they are not there."""
        known = self._held.pop(slot, None)
        self._held[slot] = pixels = load() if known is None else known  # the last one in the order
        if known is None:
            self._make_room()
        return pixels

    def _make_room(self) -> None:
        size = self.size
        *others, _ = list(self._held)
        for slot in others:
            if size > self.room:
                size -= self._held.pop(slot).numel()


PICTURES = Pictures(ROOM)
"""Of the whole process."""
