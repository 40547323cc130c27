"""The method ``fragprune-splatfacto`` as nerfstudio registers it; its entry point loads this."""

from __future__ import annotations

from copy import deepcopy

from nerfstudio.configs.method_configs import method_configs
from nerfstudio.plugins.types import MethodSpecification

from fragprune_nerfstudio import METHOD
from fragprune_nerfstudio.model import FragpruneSplatfactoConfig


def _config() -> object:
    """splatfacto's own, longer by stage 2."""
    config = deepcopy(method_configs["splatfacto"])
    model = FragpruneSplatfactoConfig()
    config.method_name = METHOD
    config.pipeline.model = model
    config.max_num_iterations += model.fragprune.iterations
    return config


splatfacto = MethodSpecification(
    config=_config(),
    description="splatfacto, then learned fragment pruning: faster frames. Runs without CUDA too",
)
"""splatfacto's 30,000 iterations, and stage 2 after them."""
