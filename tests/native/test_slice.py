"""Compiled slices of Gaussians in space and time against the oracle in double precision."""

import ctypes
from dataclasses import replace

import pytest
import spacetime
import torch
from spacetime import KINDS, agree, cut, gradients, leaves, moment, splats

from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.errors import InputError
from fragprune_plugins.slicing.cutting import slice_at
from fragprune_plugins.slicing.structs import Sliced, Spacetime

SIZES = (0, 1, 3, 1024 + 37)
"""None, fewer than any register has lanes, and more than one piece of work, the last one odd."""

AGREE = {
    "with time": [(kind, 200, {}, {"orders": n}) for kind in KINDS for n in (None, 0, 1, 2)],
    # below degree 3 time leaves colours alone but for one gradient
    "degrees": [
        ("joint", 100, {"degree": degree, "coefficients": (degree + 1) ** 2}, {"orders": orders})
        for degree in range(3)
        for orders in (None, 2)
    ],
    "any number": [(kind, count, {}, {}) for kind in KINDS for count in SIZES],
    "a prefilter widens the marginal": [
        (kind, 60, {}, {"prefilter_var": var}) for kind in ("apart", "joint") for var in (0, 0.05)
    ],
    "scale modifier": [(kind, 60, {}, {"scale_modifier": 0.6}) for kind in KINDS],
}


@pytest.mark.parametrize("case", AGREE)
def test_values_and_gradients_are_the_oracles(engine, case):
    for kind, count, of_splats, of_moment in AGREE[case]:
        agree(engine, splats(kind, count, **of_splats), moment(**of_moment))


def test_coefficients_that_are_not_in_use_have_no_gradient(engine):
    given = leaves(splats("joint", 50, coefficients=60), torch.float32)
    result = cut(engine, given, moment(1))
    by_sh = gradients(given, result)["sh"]
    assert by_sh[:, :32].any()
    assert not by_sh[:, 32:].any()


def test_each_output_has_its_own_gradients(engine):
    for output in spacetime.OUTPUTS:
        agree(engine, splats("joint", 60), moment(), outputs=(output,))


def test_rotations_are_used_as_given_and_gaussians_may_be_flat_and_thin(engine):
    given = splats("joint", 60)
    turned = replace(given, rotations=1.2 * given.rotations, rotations_r=0.9 * given.rotations_r)
    agree(engine, turned, moment())
    thin = given.scales * torch.tensor([1.0, 1e-3, 1e-6], dtype=torch.float64)
    agree(engine, replace(given, scales=thin), moment())


def test_who_is_not_there_is_nowhere_and_has_no_gradients(engine):
    given = leaves(splats("joint", 300), torch.float32)
    when = moment()
    result = cut(engine, given, when)
    absent = ~result.present
    assert 30 < int(absent.sum()) < 270
    assert (result.means[absent] == when.campos.float()).all()
    moved = (result.cov3d, result.opacities, result.colors, *gradients(given, result).values())
    for values in moved:
        assert not values[absent].any()
        assert values[result.present].any()


def broken(given, **changes):
    """A copy in which the first rows of some tensors hold something else."""
    values = {name: getattr(given, name).clone() for name in changes}
    for name, bad in changes.items():
        values[name][: len(bad)] = torch.tensor(bad, dtype=torch.float64).reshape(
            -1, *[1] * (values[name].ndim - 1)
        )
    return replace(given, **values)


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("kind", ["apart", "joint"])
@pytest.mark.parametrize(
    "changes", [{"scales_t": (0.0, NAN)}, {"rotations": (NAN,)}, {"scales": (INF, NAN)}]
)
def test_what_is_not_finite_is_not_there_and_spoils_nobody(engine, kind, changes):
    good = splats(kind, 40)
    good = replace(good, times=torch.full_like(good.times, spacetime.NOW + 1e-3))
    bad = leaves(broken(good, **changes), torch.float32)
    first = len(next(iter(changes.values())))
    if kind == "joint" and "scales_t" in changes:  # turned, other axes reach into time
        first, bad = 1, leaves(broken(good, scales_t=(NAN,)), torch.float32)
    result, well = cut(engine, bad, moment()), cut(engine, leaves(good, torch.float32), moment())
    assert not result.present[:first].any()
    for name in spacetime.OUTPUTS:
        assert torch.equal(getattr(result, name)[first:], getattr(well, name)[first:])
    for grad in gradients(bad, result).values():
        assert not grad[:first].any()
        assert grad.isfinite().all()


def test_a_fast_gaussian_keeps_its_shape(engine):
    """Far along in time, where a difference of covariances would lose every digit."""
    given = splats("joint", 60)
    still = torch.full_like(given.times, spacetime.NOW)
    fast = replace(given, scales_t=300 * given.scales_t, times=still)
    expected = cut(ReferenceEngine(), fast, moment())
    found = cut(engine, leaves(fast, torch.float32), moment())
    size = expected.cov3d.abs().amax(dim=1, keepdim=True)
    assert ((found.cov3d - expected.cov3d).abs() < 1e-4 * size).all()


def test_without_harmonics_there_are_no_colours(engine):
    given = leaves(replace(splats("joint", 20), sh=None), torch.float32)
    result = cut(engine, given, moment())
    assert result.colors is None
    assert gradients(given, result, ("means",))["rotations_r"].any()


def test_what_wants_no_gradient_gets_none(engine):
    given = splats("joint", 20)
    opacities = given.opacities.float().requires_grad_()
    result = cut(engine, replace(given, opacities=opacities), moment())
    assert result.opacities.requires_grad
    assert not any(t.requires_grad for t in (result.means, result.cov3d, result.colors))
    result.opacities.sum().backward()
    marginal = cut(ReferenceEngine(), given, moment()).opacities / given.opacities
    torch.testing.assert_close(opacities.grad.double(), marginal, rtol=1e-5, atol=1e-7)
    with torch.no_grad():
        assert not cut(engine, replace(given, opacities=opacities), moment()).means.requires_grad


def test_changes_in_place_before_the_way_back_are_noticed(engine):
    given = leaves(splats("joint", 20), torch.float32)
    result = cut(engine, given, moment())
    with torch.no_grad():
        given.scales.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        result.cov3d.sum().backward()


@pytest.mark.parametrize("kind", KINDS)
def test_each_input_alone_has_the_gradient_that_it_has_among_all(engine, kind):
    given, when = splats(kind, 40), moment()
    everything = leaves(given, torch.float32)
    expected = gradients(everything, cut(engine, everything, when))
    assert len(expected) >= 5
    for name in expected:
        alone = replace(given, **{name: getattr(everything, name)})
        assert torch.equal(gradients(alone, cut(engine, alone, when))[name], expected[name])


def test_the_number_of_threads_changes_no_bit(engine):
    given, before = leaves(splats("joint", 3000), torch.float32), torch.get_num_threads()
    found = []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            result = cut(engine, given, moment())
            found.append([result.means, result.colors, *gradients(given, result).values()])
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_slice_at_takes_the_fastest_engine(monkeypatch):
    given, when = splats("joint", 50), moment()
    expected = cut(ReferenceEngine(), given, when)
    assert slice_at(given, when).means.dtype == (
        torch.float32 if binding.usable_builds() else torch.float64
    )
    monkeypatch.setenv(binding.ENVIRONMENT, "off")
    assert torch.equal(slice_at(given, when).means, expected.means)


@pytest.mark.skipif(not binding.usable_builds(), reason="no compiled rasterizer here")
def test_slice_at_takes_the_engine_that_was_asked_for():
    given, when = splats("joint", 50), moment()
    expected = cut(ReferenceEngine(), given, when)

    class Drawing:
        """Another's engine, which cuts nothing."""

        name = "mine"

        def rasterize(self, inputs, thresholds):
            raise AssertionError

    for engine in ("reference", ReferenceEngine()):
        assert torch.equal(slice_at(given, when, engine=engine).means, expected.means)
    for engine in ("cpu", "auto", Drawing()):
        result = slice_at(given, when, engine=engine)
        assert result.means.dtype == torch.float32


def test_what_does_not_fit_is_refused(engine):
    good = splats("joint", 5)
    for changes in ({"times": None}, {"scales": None}, {"cov3d": torch.ones(5, 6)}):
        with pytest.raises(InputError, match="cov3d alone"):
            replace(good, **changes)
    with pytest.raises(InputError, match="at least 16"):
        replace(good, sh=good.sh[:, :15])
    for name, value in {"duration": 0.0, "sh_degree_t": 3}.items():
        with pytest.raises(InputError, match=name):
            replace(moment(), **{name: value})
    for slicer in (engine, ReferenceEngine()):
        with pytest.raises(InputError, match="at least 48 for 2 cosines"):
            cut(slicer, replace(good, sh=good.sh[:, :40]), moment())


def test_the_library_refuses_what_does_not_fit(engine):
    """Below the Python checks: the C interface stands on its own."""
    calls, error = binding.library().calls, binding.Error()
    three = torch.zeros(3).data_ptr()
    lengths = binding.Lengths(campos=3)
    good = {"count": 0, "campos": three, "duration": 1.0, "threads": 1, "lengths": lengths}
    to = Sliced()

    def status_of(*given):
        return calls.fragprune_slice(*map(ctypes.byref, (*given, error)))

    assert status_of(Spacetime(**good), to) == binding.OK
    for change in (
        *({"threads": 1025}, {"threads": 0}, {"count": -1}, {"count": 1}),
        *({"campos": None}, {"lengths": binding.Lengths(campos=2)}),
    ):
        status = status_of(Spacetime(**{**good, **change}), to)
        assert status != binding.OK
        assert error.message
    stale = Sliced()
    stale.size = 4
    assert status_of(Spacetime(**good), stale) != binding.OK
    assert b"version" in error.message
