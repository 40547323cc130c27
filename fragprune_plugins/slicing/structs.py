"""The structs of compiled code that cuts Gaussians: those of fragprune.h, and of the kernels."""

from __future__ import annotations

import ctypes
from typing import Final

from fragprune_plugins.engines.cpu import binding


class Spacetime(binding.Sized):
    """fragprune_spacetime."""

    _fields_ = (
        ("threads", ctypes.c_int32),
        *binding.several(ctypes.c_float, "timestamp duration prefilter_var scale_modifier"),
        *binding.several(ctypes.c_int32, "sh_degree sh_degree_t sh_coefficients"),
        ("count", ctypes.c_int64),
        ("lengths", binding.Lengths),
        *binding.pointers(
            "campos means opacities times scales scales_t rotations rotations_r cov3d sh"
        ),
    )


class Sliced(binding.Sized):
    """fragprune_sliced."""

    _fields_ = (*binding.pointers("means cov3d opacities colors present"),)


class SpacetimeGrads(binding.Sized):
    """fragprune_spacetime_grads."""

    _fields_ = (
        *binding.pointers("means opacities times scales scales_t rotations rotations_r cov3d sh"),
    )


class Slicing(ctypes.Structure):
    """fp::Slicing: the argument of the kernels that cut Gaussians at a moment, both ways."""

    _fields_ = (("given", Spacetime), ("sliced", Sliced), ("to", SpacetimeGrads))


MACROS: Final = {"FP_SLICING_SIZE": ctypes.sizeof(Slicing)}
"""With what native/cuda/slice.cu is compiled, to check that it knows the same struct."""
