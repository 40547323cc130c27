"""Every kernel compiles for every architecture, and none of its numbers leaves the registers."""

import re
from concurrent.futures import ThreadPoolExecutor

import pytest

from fragprune_plugins.engines.cuda import kernels
from fragprune_plugins.engines.cuda.frame import MACROS, unblend_macros
from fragprune_plugins.slicing import structs
from fragprune_plugins.workbench.doctor.work import VARIANTS, resources

ARCHITECTURES = (
    90,
    *(pytest.param(n, marks=pytest.mark.slow) for n in (75, 80, 86, 87, 89, 100, 120)),
)

REGISTERS = {"fp_project": 85}
"""At most so many: room for three blocks of 256 threads in the 65,536 of a multiprocessor."""

OTHERS = 128
"""For two."""

EVERYTHING = {
    "FP_FEATURES": 8,
    **dict.fromkeys(("FP_COUNTS", "FP_SCORES", "FP_GEOMETRY", "FP_COLOUR"), 1),
    **dict.fromkeys(("FP_THRESHOLD", "FP_DEPTH", "FP_ABSOLUTE", "FP_OFFSETS"), 1),
}

TRAINED = unblend_macros(frozenset(("means", "opacities", "thresholds")), sh_turns=True)
"""Training that asks for no depth: three blocks of it shall fit."""

TUNED = unblend_macros(frozenset(("opacities", "thresholds")), sh_turns=True)
"""Fine-tuning."""


def check(image: kernels.Image) -> None:
    found = resources(image.log)
    assert found
    for name, needs in found.items():
        assert (needs["stack"], needs["spills"]) == (0, 0), (name, needs)
        assert needs["registers"] <= REGISTERS.get(name, OTHERS), (name, needs)
        assert needs["shared"] <= 48 << 10, (name, needs)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_all_kernels_compile_without_stack_or_spills(nvrtc, architecture):
    assert architecture in nvrtc.architectures
    with ThreadPoolExecutor(2) as pool:
        jobs = [
            pool.submit(nvrtc.compile, source, {**MACROS, **macros}, f"sm_{architecture}")
            for source, macros in (
                ("scene", {}),
                ("slice", structs.MACROS),
                ("unblend", {}),
                ("unblend", TRAINED),
                ("unblend", TUNED),
                ("blend", {}),
            )
        ]
    for job in jobs:
        assert job.result().code.startswith(b"\x7fELF")
        check(job.result())


def test_volta_is_drawn_on_where_the_toolkit_still_makes_code_for_it(nvrtc, monkeypatch):
    """It has all that kernels need; NVRTC 12 knows it, and 13 does not."""
    monkeypatch.setattr(nvrtc._nvrtc, "nvrtcGetSupportedArchs", lambda: (0, [60, 70, 75]))
    assert kernels.target_of(70, kernels.Nvrtc().architectures) == "sm_70"


@pytest.mark.parametrize("source", ["blend", "unblend"])
def test_all_that_can_be_asked_for_at_once_compiles(nvrtc, source):
    check(nvrtc.compile(source, {**MACROS, **EVERYTHING}, "sm_75"))


def test_the_sources_check_the_structs_that_they_are_handed(nvrtc):
    for name in MACROS:
        with pytest.raises(kernels.Unavailable, match="has other fields"):
            nvrtc.compile("unblend", {**MACROS, name: 8}, "sm_90")


def test_a_gpu_that_the_toolkit_does_not_know_gets_ptx(nvrtc):
    assert kernels.target_of(90, (75, 90)) == "sm_90"
    assert kernels.target_of(99, (75, 90, 100)) == "compute_90"
    with pytest.raises(kernels.Unavailable, match="older"):
        kernels.target_of(70, (75, 90))
    code = nvrtc.compile("scene", MACROS, "compute_75").code
    assert b".target sm_75" in code
    # A driver may fuse what says nothing of rounding, and two kernels would disagree by a bit.
    assert not re.search(rb"\b(mul|add|sub)\.(f32|f64)", code)


def test_what_is_built_beforehand_is_what_training_asks_for():
    assert {source for source, _ in VARIANTS} == {"scene", "blend", "unblend"}
