"""splatfacto's call of gsplat's ``rasterization``."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

from torch import Tensor

from fragprune_gsplat.dialect import GsplatDialect
from fragprune_nerfstudio.exporting import rows_among
from fragprune_plugins.adapting import HostCall


class NerfstudioDialect(GsplatDialect):
    """gsplat's dialect; the viewer's crop box makes a call draw some of the model's rows."""

    def rows_drawn(self, model: Any, call: HostCall) -> Tensor | None:
        """The rows inside the viewer's crop box; None without one."""
        own = model.gauss_params
        if call["means"] is own["means"]:
            return None
        keys = ("means", "quats")  # what the call has as the model has it
        drawn = {key: call[key].detach() for key in keys}
        rows = rows_among({key: own[key].detach() for key in keys}, drawn, "the viewer's crop")
        return rows.to(call["means"].device)

    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """None: splatfacto calls no kernel beside ``rasterization``."""
        return {}
