"""How a record says how its models are drawn, and what they were measured against."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from fragprune_plugins.hosts.photographs import Photographs, Resolution
from fragprune_plugins.workbench.figures.records import RECORD_FILE, Record, located

_NUMBERS = {"scale_modifier", "dilation", "near", "alpha_max"}
"""Fields of ``RasterInputs`` that a record may set to a number."""


@dataclass(frozen=True)
class Recorded:
    """The "photographs" of a record.

    Attributes:
        models: the model before and the model after; joint learning leaves the latter alone.
        filtered: whether the models may be such as only their host's rules draw; see ``read_ply``.
        drawing: fields of ``RasterInputs`` that differ from vanilla's rules.
    """

    photographs: Photographs
    models: tuple[Path, ...]
    filtered: bool = False
    drawing: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for ``recorded``."""
        return plain(self.photographs) | {
            "models": [str(model.resolve()) for model in self.models],
            "filtered": self.filtered,
            "drawing": dict(self.drawing),
        }


def plain(photographs: Photographs) -> dict[str, Any]:
    """Plain values, for records."""
    return asdict(photographs) | {"folder": str(photographs.folder.resolve())}


def recorded(record: Record) -> Recorded | None:
    """The photographs and models of a record; None if it names none.

    Raises:
        RecordError: they are of other types.
    """
    with RECORD_FILE.stated(record.path) as reading:
        values = record.data.get("photographs")
        if values is None:
            return None
        reading.place = "data.photographs"
        folder = record.path.parent
        models = tuple(located(each, folder) for each in values["models"])
        if not 1 <= len(models) <= 2:
            raise ValueError(f"{len(models)} models")
        drawing = dict(values["drawing"])
        for name, value in drawing.items():
            number = isinstance(value, int | float) and 0 <= value < 1e6
            if not (number if name in _NUMBERS else name == "compensation"):
                raise ValueError(f"{name} is {value!r}")
        filtered = bool(values["filtered"])
        scene, size = located(values["folder"], folder), Resolution(**values["resolution"])
        photographs = Photographs(scene, size, values["white_background"], values["images"])
        return Recorded(photographs, models, filtered, drawing)
