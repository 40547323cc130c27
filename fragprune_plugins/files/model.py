"""A trained splat as its file holds it, with the thresholds that truncate it."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.errors import AlignmentError, InputError
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.types import Rim, Splats, check_fields, one_line

REST_COUNTS = {3 * (degree + 1) ** 2 - 3: degree for degree in range(4)}  # SH degrees


@dataclass(frozen=True, eq=False)
class Model:
    """A trained splat: N Gaussians before activation, float32, and how far each of them reaches.

    Attributes:
        xyz: (N, 3) means, world.
        f_dc: (N, 1, 3) first SH coefficient.
        f_rest: (N, K - 1, 3) the other coefficients, K = (degree + 1)^2.
        opacity: (N, 1) logits.
        scaling: (N, 3) logarithms of standard deviations; (N, 2) of surfels.
        rotation: (N, 4) quaternions w, x, y, z of any length.
        thresholds: N truncation thresholds, and the ``rules``; None for a model that has neither.
        filter_3d: (N, 1) Mip-Splatting's 3D filter, a standard deviation in world units. It widens
            every axis and lowers the opacity accordingly.

    Raises:
        InputError: a tensor has another shape.
        AlignmentError: Gaussians and thresholds differ in number.
    """

    xyz: Tensor
    f_dc: Tensor
    f_rest: Tensor
    opacity: Tensor
    scaling: Tensor
    rotation: Tensor
    thresholds: ThresholdStore | None = None
    filter_3d: Tensor | None = None

    __repr__ = one_line

    def __post_init__(self) -> None:
        n, axes = len(self.xyz), 2 if tuple(self.scaling.shape[1:]) == (2,) else 3
        check_fields(self, xyz=(n, 3), f_dc=(n, 1, 3), f_rest=(n, None, 3), opacity=(n, 1))
        check_fields(self, scaling=(n, axes), rotation=(n, 4), filter_3d=(n, 1))
        if 3 * self.f_rest.shape[1] not in REST_COUNTS:
            found = f"{self.f_rest.shape[1]} coefficients"
            remedy = "Pass f_rest as (N, coefficients, 3), without the first coefficient."
            raise InputError("Model.f_rest", found, "0, 3, 8 or 15 (SH degree 0 to 3)", remedy)
        if self.thresholds is not None and len(self.thresholds) != n:
            found = f"a store of {len(self.thresholds)} thresholds"
            remedy = "Pass the store of this very model."
            raise AlignmentError("Model.thresholds", found, f"{n}, one per Gaussian", remedy)

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def sh_degree(self) -> int:
        """The SH degree, 0 to 3, from the number of coefficients."""
        return REST_COUNTS[3 * self.f_rest.shape[1]]

    @property
    def device(self) -> torch.device:
        """Where its tensors are."""
        return self.xyz.device

    @property
    def tensors(self) -> dict[str, Tensor]:
        """The tensors of the Gaussians by name, without the thresholds."""
        held = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: each for name, each in held.items() if isinstance(each, Tensor)}

    @property
    def falloff(self) -> Tensor | None:
        """(N,) thresholds in (0, 1) to draw with, without gradient; None if nothing is truncated.

        Plugins are not asked; ``rasterize`` asks them.
        """
        store = self.thresholds
        return None if store is None or store.neutral else store.values.detach()

    @property
    def stop(self) -> float | None:
        """The share of light at which its pixels stop, see ``RasterInputs``; None: as hosts do."""
        return None if self.thresholds is None else self.thresholds.stop

    @property
    def rim(self) -> Rim:
        """How its thresholds cut, see ``RasterInputs``."""
        return "hard" if self.thresholds is None else self.thresholds.rim

    @property
    def rules(self) -> dict[str, Any]:
        """Stop and rim for its drawing: ``RasterInputs(view, model.splats(), **model.rules)``."""
        return {"stop": self.stop, "rim": self.rim}

    @property
    def pruned(self) -> bool:
        """Whether thresholds or a stop decide anything: others draw another picture of it."""
        return self.thresholds is not None and self.thresholds.cuts

    def untruncated(self) -> Model:
        """The same Gaussians without thresholds and stop."""
        return replace(self, thresholds=None)

    def with_rules(self, **rules: Any) -> Model:
        """The same model with other ``rules``: a stop from 1e-4 to 1, a rim."""
        known = self.thresholds
        store = ThresholdStore(len(self), self.device) if known is None else known.clone()
        return replace(self, thresholds=store.ruled(**rules))

    def to(self, device: torch.device | str) -> Model:
        """The same model on a device; tensors that are there already are not copied."""
        moved: dict[str, Any] = {name: each.to(device) for name, each in self.tensors.items()}
        if self.thresholds is not None and self.thresholds.logits.device != torch.device(device):
            moved["thresholds"] = self.thresholds.clone(device)
        return replace(self, **moved)

    def keep(self, mask: Tensor) -> Model:
        """A copy of the rows where mask (N,) bool is True, in their order; moments are kept."""
        store = self.with_rules().thresholds  # a copy, which refuses what is no mask
        store.keep(mask)  # type: ignore[union-attr]
        kept: dict[str, Any] = {name: rows[mask] for name, rows in self.tensors.items()}
        return replace(self, **kept, thresholds=None if self.thresholds is None else store)

    def splats(self, sh_apart: bool = False) -> Splats:
        """The Gaussians after activation, for engines; differentiable.

        With ``sh_apart``, f_dc and f_rest stay as they are, for an engine that reads both.
        """
        opacities, scales = torch.sigmoid(self.opacity[:, 0]), torch.exp(self.scaling)
        if self.filter_3d is not None:
            wider = (scales.square() + self.filter_3d.square()).sqrt()
            opacities = opacities * (scales / wider).prod(dim=1)
            scales = wider
        return Splats(
            means=self.xyz,
            opacities=opacities,
            scales=scales,
            rotations=torch.nn.functional.normalize(self.rotation),
            sh=self.f_dc if sh_apart else torch.cat([self.f_dc, self.f_rest], dim=1),
            sh_rest=self.f_rest if sh_apart else None,
            sh_degree=self.sh_degree,
        )
