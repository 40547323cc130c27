"""Slices of Gaussians in space and time: the kernels' own sources, emulated, against the oracle."""

import ctypes

import pytest
import torch
from spacetime import KINDS, OUTPUTS, agree, cut, gradients, leaves, moment, splats

from fragprune_plugins.engines.cpu.engine import CpuEngine
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.errors import EngineError
from fragprune_plugins.slicing.cutting import expect_right


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("orders", [None, 0, 2])
def test_values_and_gradients_are_the_oracles(engine, kind, orders):
    agree(engine, splats(kind, 100), moment(orders, prefilter_var=0.02, scale_modifier=0.9))


@pytest.mark.parametrize("degree", range(4))
def test_every_degree(engine, degree):
    agree(engine, splats("joint", 70, degree=degree), moment(1))


@pytest.mark.parametrize("output", OUTPUTS)
def test_each_output_has_its_own_gradients(engine, output):
    agree(engine, splats("joint", 60), moment(), outputs=(output,))


@pytest.mark.parametrize("count", [0, 1, 300])
def test_any_number_of_them(engine, device, count):
    expect_right(device, torch.device("cpu"))
    before = len(device.launched)
    agree(engine, splats("joint", count), moment())
    kernels = [name for name, _ in device.launched[before:]]
    assert kernels == (["fp_slice", "fp_unslice"] if count else [])


def test_who_is_not_there_is_as_in_the_cpu_engine(engine):
    given, when = leaves(splats("joint", 300, coefficients=50), torch.float32), moment()
    ours, theirs = cut(engine, given, when), cut(CpuEngine(), given, when)
    absent = ~ours.present
    assert absent.any()
    assert torch.equal(absent, ~theirs.present)
    for name in OUTPUTS:
        assert torch.equal(getattr(ours, name)[absent], getattr(theirs, name)[absent])
    assert not any(g[absent].any() for g in gradients(given, ours).values())


def test_a_gpu_that_cuts_wrongly_is_refused(device):
    class Faulty:
        kind = "cpu"

        def launch(self, where, source, macros, kernel, blocks, arguments):
            device.launch(where, source, macros, kernel, blocks, arguments)
            if kernel == "fp_slice":
                (ctypes.c_float * 3000).from_address(arguments.sliced.opacities)[2999] = 2.0

    with pytest.raises(EngineError, match="opacities are off by"):
        cut(CudaEngine(Faulty()), leaves(splats("joint", 20), torch.float32), moment())
