"""What goes into compiled code: every field arrives, and no array is read beyond its end."""

import ctypes
from dataclasses import Field, fields, replace
from typing import Any

import pytest
import scenes
import spacetime
import torch

from fragprune_plugins.adapting import EngineError, Footprints, RasterInputs, Splats, View
from fragprune_plugins.engines.calling import native_arrays, native_inputs
from fragprune_plugins.engines.cpu.binding import address
from fragprune_plugins.engines.cpu.engine import CpuEngine, binding
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.slicing.cutting import Way, slice_by
from fragprune_plugins.slicing.structs import Spacetime

N = 20
WORLD = scenes.random_scene(0, N, features=2, stop=0.3)


def apart(inputs: RasterInputs) -> RasterInputs:
    """The same with the first coefficient in one array and the others in another."""
    splats = inputs.splats
    assert isinstance(splats, Splats)
    assert splats.sh is not None
    sh, rest = splats.sh[:, :1].contiguous(), splats.sh[:, 1:].contiguous()
    return replace(inputs, splats=replace(splats, sh=sh, sh_rest=rest))


GIVEN = {
    "world": WORLD,
    "coefficients apart": apart(WORLD),
    "colours and covariances": scenes.random_scene(0, N, cov3d=True, colors=True),
    "offsets": scenes.random_scene(0, N, offsets=True),
    "image": scenes.footprints_of(WORLD),
}
THRESHOLDS = scenes.random_thresholds(0, N)

NO_INPUTS = {"view", "splats", "means2d_hook", "counts", "scores", "planes"}
"""Fields that hold others, whose values are not used, or that say what comes back."""


def values(inputs: RasterInputs) -> dict[str, Any]:
    """What the struct says, and what is where it points."""
    arrays = native_arrays(inputs, THRESHOLDS)
    struct = native_inputs(inputs, arrays, widen=False)
    found: dict[str, Any] = {}
    for name, kind in binding.Inputs._fields_:
        if name in binding.ARRAYS:
            array = arrays.get(name)
            assert getattr(struct, name) == address(array)
            assert getattr(struct.lengths, name) == (0 if array is None else array.numel())
            found[name] = None if array is None else array.tolist()
        elif kind is not binding.Lengths:
            found[name] = getattr(struct, name)
    return found


def other(name: str, value: Any) -> Any:
    """A value that differs."""
    if name == "compensation":
        return "mip"
    if name == "rim":
        return "soft"
    if isinstance(value, bool):
        return not value
    return value / 2 if isinstance(value, float) else value + 1


def owned(inputs: RasterInputs) -> list[tuple[str, Field]]:
    """Fields of a rasterization and of what it holds, by the owner's name; those that are given."""
    owners = {"": inputs, "view": inputs.view, "splats": inputs.splats}
    return [
        (place, field)
        for place, owner in owners.items()
        for field in fields(owner)
        if field.name not in NO_INPUTS and getattr(owner, field.name) is not None
    ]


CHANGES = [
    pytest.param(kind, place, field.name, id=f"{kind}: {field.name}")
    for kind, inputs in GIVEN.items()
    for place, field in owned(inputs)
    if not (kind == "offsets" and field.name in ("width", "height"))  # are as many as pixels
]


@pytest.mark.parametrize(("kind", "place", "name"), CHANGES)
def test_every_field_reaches_compiled_code(kind, place, name):
    """A new field fails here until calling.py hands it on, or ``NO_INPUTS`` says why not."""
    inputs = GIVEN[kind]
    owner = getattr(inputs, place) if place else inputs
    changed = replace(owner, **{name: other(name, getattr(owner, name))})
    assert values(replace(inputs, **{place: changed}) if place else changed) != values(inputs)


@pytest.mark.parametrize("owner", [View, Splats, Footprints, RasterInputs])
def test_no_field_is_left_out_above(owner):
    tried = {
        field.name
        for inputs in GIVEN.values()
        for place, field in owned(inputs)
        if isinstance(getattr(inputs, place) if place else inputs, owner)
    }
    assert tried == {field.name for field in fields(owner)} - NO_INPUTS


@pytest.mark.parametrize("flat", [False, True], ids=["ellipsoids", "surfels"])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_coefficients_in_two_arrays_are_drawn_and_learned_as_those_in_one(library, degree, flat):
    """To the bit, and as the oracle has it: it joins them."""
    scene = scenes.random_scene(3, 60, sh_degree=degree, flat=flat)
    one, whole = scenes.leaves(scene)
    two, parts = scenes.leaves(apart(scene))
    engine, weights = CpuEngine(library), torch.rand(scene.view.height, scene.view.width)
    images = [engine.rasterize(inputs, None).image for inputs in (one, two)]
    assert torch.equal(*images)
    for image in images:
        (image * weights).sum().backward()
    joined = torch.cat([parts.pop("sh").grad, parts.pop("sh_rest").grad], dim=1)
    assert torch.equal(joined, whole.pop("sh").grad)
    for name, leaf in parts.items():
        assert torch.equal(leaf.grad, whole[name].grad), name
    expected = ReferenceEngine().rasterize(two, None).image
    assert torch.allclose(images[1], expected, atol=1e-5)


def test_a_struct_has_no_fields_that_c_does_not_know():
    with pytest.raises(TypeError, match="gamma"):
        binding.Inputs(width=3, gamma=2.2)


def test_a_number_in_a_tensor_stays_a_number():
    given = binding.Inputs(near=torch.tensor(0.25), count=torch.tensor(7), means=torch.ones(1, 3))
    assert (given.near, given.count) == (0.25, 7)
    assert given.means


def draw(library: binding.Library, inputs: binding.Inputs) -> tuple[int, str]:
    """Status and message of a forward pass."""
    image, radii = torch.empty(3, inputs.height, inputs.width), torch.empty(N, dtype=torch.int32)
    outputs = binding.Outputs(image=address(image), radii=address(radii))
    error = binding.Error()
    status = library.calls.fragprune_forward(
        ctypes.byref(inputs), ctypes.byref(outputs), None, ctypes.byref(error)
    )
    return status, error.message.decode()


THREADS, COEFFICIENTS = "threads must be 1 to 1024", "sh_coefficients must be 0 to 1024"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        *(({"stop": stop}, "stop must be") for stop in (0.5e-4, -0.1, float("nan"))),
        ({"stop": 0.1, "alpha_max": 1.0}, "alpha_max must be"),
        *(({"threads": count}, THREADS) for count in (0, -5, 1025)),
        *(({"sh_coefficients": count}, COEFFICIENTS) for count in (-1, 1025, 2**31 - 1)),
    ],
)
def test_a_number_that_cannot_be_is_refused(library, given, said):
    inputs = native_inputs(WORLD, arrays := native_arrays(WORLD, None), widen=False)
    assert len(arrays) > 5  # alive while they are read
    for name, value in given.items():
        setattr(inputs, name, value)
    status, message = draw(library, inputs)
    assert status != binding.OK
    assert message.startswith(said)


@pytest.mark.parametrize("kind", GIVEN)
def test_an_array_of_another_length_is_refused_by_its_name(library, kind):
    inputs = GIVEN[kind]
    arrays = native_arrays(inputs, THRESHOLDS)
    assert draw(library, native_inputs(inputs, arrays, widen=False)) == (binding.OK, "")
    for name in dict(binding.Inputs._fields_).keys() & set(binding.ARRAYS):
        for more in (-1, 1, 2**62):
            given = native_inputs(inputs, arrays, widen=False)
            held = getattr(given.lengths, name)
            setattr(given.lengths, name, held + more)
            status, message = draw(library, given)
            assert status != binding.OK
            assert message.startswith(f"{name} holds {held + more} numbers where {held} are read")


class Doubting:
    """Cuts as the cpu engine does, once it has been refused with each array said to be shorter."""

    where = torch.device("cpu")

    def __init__(self, library: binding.Library) -> None:
        self.calls, self.refused = library.calls, 0

    def empty(self, *shape: int) -> torch.Tensor:
        return torch.empty(shape)

    def call(self, way: Way, given: Spacetime, *more: ctypes.Structure) -> None:
        error, function = binding.Error(), getattr(self.calls, f"fragprune_{way}")
        structs = [ctypes.byref(struct) for struct in (given, *more, error)]
        for name in dict(Spacetime._fields_).keys() & set(binding.ARRAYS):
            held = getattr(given.lengths, name)
            setattr(given.lengths, name, held - 1)
            assert function(*structs) != binding.OK
            assert error.message.decode().startswith(f"{name} holds {held - 1} numbers")
            setattr(given.lengths, name, held)
            self.refused += 1
        assert function(*structs) == binding.OK


def test_a_cut_of_arrays_of_another_length_is_refused_by_name(library):
    blade = Doubting(library)
    splats = spacetime.leaves(spacetime.splats("joint", N), torch.float32)
    slice_by(blade, splats, spacetime.moment()).means.sum().backward()
    assert blade.refused == 2 * 10  # there and back


def test_memory_resized_behind_the_checks_is_not_read(engine):
    """Values are checked when they are made; a tensor can be changed in place afterwards."""
    inputs = scenes.random_scene(0, N)
    inputs.splats.opacities.resize_(3)
    with pytest.raises(EngineError, match=f"opacities holds 3 numbers where {N} are read"):
        engine.rasterize(inputs, None)
