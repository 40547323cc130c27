"""Slices of Gaussians in space and time: the kernels' own sources, emulated, against the oracle."""

import ctypes
from functools import partial

import pytest
import torch
from gpu.emulated import Watched, double_by_default
from native.test_slice import (
    test_coefficients_that_are_not_in_use_have_no_gradient,
    test_each_output_has_its_own_gradients,
    test_values_and_gradients_are_the_oracles,
    test_who_is_not_there_is_nowhere_and_has_no_gradients,
)
from spacetime import agree, cut, leaves, moment, splats

from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.errors import EngineError
from fragprune_plugins.slicing.cutting import expect_right

# those of the cpu engine, over this one
__all__ = [
    "test_coefficients_that_are_not_in_use_have_no_gradient",
    "test_each_output_has_its_own_gradients",
    "test_values_and_gradients_are_the_oracles",
    "test_who_is_not_there_is_nowhere_and_has_no_gradients",
]


@pytest.mark.parametrize("count", [0, 1, 300])
def test_any_number_of_them(engine, device, count):
    expect_right(device, torch.device("cpu"))
    before = len(device.launched)
    agree(engine, splats("joint", count), moment())
    kernels = [name for name, _ in device.launched[before:]]
    assert kernels == (["fp_slice", "fp_unslice"] if count else [])


@pytest.mark.parametrize(
    "state",
    [torch.no_grad, torch.inference_mode, double_by_default, partial(torch.device, "meta")],
    ids=["no gradients", "inference", "double by default", "another device by default"],
)
def test_a_gpu_is_tried_whatever_the_host_has_set(device, state):
    expect_right.cache_clear()
    with state():
        expect_right(device, torch.device("cpu"))


def test_a_gpu_that_cuts_wrongly_is_refused(device):
    def tamper(kernel, arguments):
        if kernel == "fp_slice":
            (ctypes.c_float * 3000).from_address(arguments.sliced.opacities)[2999] = 2.0

    given = leaves(splats("joint", 20), torch.float32)
    with pytest.raises(EngineError, match="opacities are off by"):
        cut(CudaEngine(Watched(device, tamper)), given, moment())
