"""The calls of forks: values besides the picture, and what must be neutral or stand still."""

from collections import namedtuple
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import scenes
import torch
from elsewhere import TensorFloat32

from fragprune_3dgs_fork import ForkDialect, plane_depth
from fragprune_3dgs_fork.fork import Fork, Output
from fragprune_graphdeco import GraphdecoDialect, likeness, proof, warn_once
from fragprune_plugins.adapting import EngineError, HostCall, HostRepo
from fragprune_plugins.engines import create_engine
from fragprune_plugins.injection.rasterizing import further_picture
from fragprune_plugins.injection.state import ModelState
from fragprune_plugins.learning.thresholds import ThresholdStore

ROLES = ("image", "radii", "objects", "alpha", "depth", "invdepth", "unread")
VALUES = {"p": tuple(Output(each, each) for each in ROLES)}
FORK = Fork(HostRepo(Path()), outputs=VALUES, blended={"p": "sh_objs"})
DIALECT = ForkDialect("p", (), 2, fork=FORK)
OBJECTS = 19


def call_of(scene, objects, still=True, columns=3, **settings):
    view, splats = scene.view, scene.splats
    given = {
        "image_height": view.height,
        "image_width": view.width,
        "tanfovx": view.tan_fov_x,
        "tanfovy": view.tan_fov_y,
        "bg": view.background,
        "scale_modifier": 1.0,
        "viewmatrix": view.viewmatrix,
        "projmatrix": view.projmatrix,
        "sh_degree": splats.sh_degree,
        "campos": view.campos,
    }
    arguments = {
        "means3D": splats.means,
        "means2D": torch.zeros(len(splats), columns),
        "opacities": splats.opacities[:, None],
        "shs": splats.sh,
        "scales": splats.scales,
        "rotations": splats.rotations,
        "sh_objs": objects,
    } | {name: settings.pop(name) for name in ("theta", "rho") if name in settings}
    given |= settings
    packed = namedtuple("Settings", given)(**given)
    return HostCall(packed, arguments, "p:GaussianRasterizer.forward", still=still)


@pytest.fixture
def scene():
    found = scenes.random_scene(0, 40)
    found.splats.means.requires_grad_(True)
    return found


@pytest.fixture
def objects():
    return torch.rand(40, 1, OBJECTS, generator=torch.Generator().manual_seed(0))


def test_a_call_draws_from_where_the_kernel_in_the_checkout_begins(scene, tmp_path):
    folder = tmp_path / "submodules/p"
    (folder / "p").mkdir(parents=True)
    (folder / "p/__init__.py").write_text("")
    (folder / "auxiliary.h").write_text("if (p_view.z <= 0.01f) return false;")
    (folder / "forward.cu").write_text("")
    for root, near in ((tmp_path, 0.01), (tmp_path / "submodules/p/p", 0.2)):
        fork = replace(FORK, repo=HostRepo(root))
        dialect = replace(DIALECT, fork=fork)
        assert dialect.unpack(call_of(scene, None)).near == near


def blended(engine, scene, channel):
    """One channel alone."""
    splats = replace(scene.splats, features=channel)
    return engine.rasterize(replace(scene, splats=splats), None).features


def test_every_value_is_in_its_place_with_its_gradient(scene, objects):
    engine, call = create_engine("reference"), call_of(scene, objects)
    drawn = DIALECT.answer(call, DIALECT.unpack(call), lambda each: engine.rasterize(each, None))
    values = dict(zip(ROLES, drawn, strict=True))
    plain = engine.rasterize(scene, None)
    for name in ("image", "radii", "alpha", "invdepth"):
        assert torch.equal(values[name], getattr(plain, name)), name
    for number in (0, 7, 8, OBJECTS - 1):
        alone = blended(engine, scene, objects[:, 0, number : number + 1])
        torch.testing.assert_close(values["objects"][number : number + 1], alone)
    homogeneous = torch.cat([scene.splats.means, torch.ones(40, 1)], dim=1)
    z = (homogeneous @ scene.view.viewmatrix)[:, 2:3]
    alone = blended(engine, scene, z)
    torch.testing.assert_close(values["depth"], alone)
    (expected,) = torch.autograd.grad(alone.sum(), scene.splats.means, retain_graph=True)
    (found,) = torch.autograd.grad(values["depth"].sum(), scene.splats.means)
    assert expected.abs().max() > 0
    torch.testing.assert_close(found, expected)


MAPS = tuple(Output(each, each) for each in ("image", "radii", "objects", "plane"))
PLANES = replace(FORK, outputs={"p": MAPS}, asking=frozenset({"asked"}))


@pytest.mark.parametrize("count", [5, 9])
def test_a_plane_that_channels_hold_is_met_by_every_pixels_ray(scene, count):
    engine, dialect = create_engine("reference"), replace(DIALECT, fork=PLANES)
    scene.splats.opacities.data[10:] = 0  # few enough to leave pixels empty
    channels = torch.rand(40, count, generator=torch.Generator().manual_seed(1)) + 0.5
    call = call_of(scene, channels.requires_grad_(True), asked=True)
    drawn = dialect.answer(call, dialect.unpack(call), lambda each: engine.rasterize(each, None))
    normals, distances = drawn[2][:3].double(), drawn[2][4].double()
    empty = drawn[2][4] == 0
    assert empty.any()
    assert not empty.all()
    for y, x in (~empty).nonzero()[::97]:
        across = (float(x) - scene.view.width / 2) / (scene.view.width / 2) * scene.view.tan_fov_x
        down = (float(y) - scene.view.height / 2) / (scene.view.height / 2) * scene.view.tan_fov_y
        ray = torch.tensor([across, down, 1.0], dtype=torch.float64)
        met = -distances[y, x] / (normals[:, y, x] @ ray)
        torch.testing.assert_close(drawn[3][0, y, x].double(), met, rtol=1e-5, atol=1e-6)
    assert not drawn[3][0][empty].any()
    nothing = torch.zeros(count, 3, 4, requires_grad=True)
    (found,) = torch.autograd.grad(plane_depth(nothing, call.settings).sum(), nothing)
    assert not found.any()  # a fragment beyond its threshold would get 1e8


def test_channels_that_a_host_does_not_ask_for_are_not_drawn_and_not_read(scene, objects):
    engine, dialect = create_engine("reference"), replace(DIALECT, fork=PLANES)
    for given, asked in ((objects, False), (None, True), (None, False)):
        call = call_of(scene, given, asked=asked)
        inputs = dialect.unpack(call)
        assert inputs.splats.features is None
        _, _, *values = dialect.answer(call, inputs, lambda each: engine.rasterize(each, None))
        for value in values:
            with pytest.raises(EngineError, match="the rasterizer's value"):
                value.mean()


@pytest.mark.parametrize("detached", ["objects", "depth", "alpha", "invdepth"])
def test_a_value_that_moves_no_gaussian_is_drawn_all_the_same(scene, objects, detached):
    roles = tuple(replace(each, detached=each.role == detached) for each in VALUES["p"])
    dialect = replace(DIALECT, fork=replace(FORK, outputs={"p": roles}))
    engine, call = create_engine("reference"), call_of(scene, objects.requires_grad_(True))

    def answered(by):
        drawn = by.answer(call, by.unpack(call), lambda each: engine.rasterize(each, None))
        return dict(zip(ROLES, drawn, strict=True))

    values, moving = answered(dialect), answered(DIALECT)
    for name in ("objects", "depth", "alpha", "invdepth"):
        torch.testing.assert_close(values[name], moving[name])
        leaves = (scene.splats.means, objects) if name == "objects" else (scene.splats.means,)
        found, expected = (gradients(each[name], leaves) for each in (values, moving))
        if name == detached:
            assert not found[0].any()
            assert expected[0].any()
        torch.testing.assert_close(found[1:], expected[1:])


def gradients(value, leaves):
    if not value.requires_grad:
        return [torch.zeros_like(each) for each in leaves]
    return list(torch.autograd.grad(value.sum(), leaves, retain_graph=True))


READS = {
    "a sum": lambda value: value + 1,
    "a sum, turned round": lambda value: 1 + value,
    "an entry": lambda value: value[0],
    "a method": lambda value: value.mean(),
    "a function": torch.sum,
    "a comparison": lambda value: value > 0,
    "a number": float,
    "a stack": lambda value: torch.stack([torch.zeros(1), value]),
}


@pytest.mark.parametrize("how", READS)
def test_a_value_that_was_seen_unread_may_be_handed_on_and_not_read(scene, objects, how):
    engine, call = create_engine("reference"), call_of(scene, objects)
    value = DIALECT.answer(call, DIALECT.unpack(call), lambda each: engine.rasterize(each, None))
    package = {"touched": value[-1]}
    with pytest.raises(EngineError, match=r"the rasterizer's value (unread|in a list)"):
        READS[how](package["touched"])


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({"confidence": torch.full((40, 1), 0.5)}, "confidence"),
        ({"still": False, "columns": 4}, "means2D"),
        ({"theta": torch.ones(3)}, "theta"),
        ({"still": False, "rho": torch.zeros(3, requires_grad=True)}, "rho"),
    ],
)
def test_what_our_engines_would_leave_out_is_refused(scene, objects, given, what):
    with pytest.raises(EngineError, match=what):
        DIALECT.unpack(call_of(scene, objects, **given))


@pytest.mark.parametrize(("columns", "still"), [(3, False), (4, True), (4, False)])
def test_other_adapters_warn_of_columns_without_a_gradient(scene, objects, caplog, columns, still):
    """2DGS with MCMC gives means2D four, and densifies by two of these only if asked to."""
    warn_once.cache_clear()
    GraphdecoDialect("p", (), 2).unpack(call_of(scene, objects, still=still, columns=columns))
    assert ("means2D has 4 columns" in caplog.text) == (columns > 3 and not still)


@pytest.mark.parametrize(
    "given", [{"confidence": torch.ones(40, 1)}, {"columns": 4}, {"theta": torch.zeros(3)}]
)
def test_what_changes_nothing_is_served(scene, objects, given):
    assert DIALECT.unpack(call_of(scene, objects, **given)).splats.features is not None


def test_a_rasterizer_that_no_script_reaches_is_refused(scene, objects):
    call = replace(call_of(scene, objects), entry="q:GaussianRasterizer.forward")
    with pytest.raises(EngineError, match="q: a function that no training script calls"):
        DIALECT.unpack(call)


def test_a_proof_sees_every_value_beside_its_own_channel(scene, objects):
    engine, call = create_engine("reference"), call_of(scene, objects)
    inputs = DIALECT.unpack(call)
    values, seen = proof._packed(DIALECT, call, inputs, lambda each: engine.rasterize(each, None))
    assert len(values[2]) == OBJECTS
    torch.testing.assert_close(seen.drawn.features[-1:], values[4])


def test_only_the_first_picture_of_a_view_in_a_step_is_pressed():
    state = ModelState(ThresholdStore(3))
    state.steps = 1
    assert not further_picture(state, (5, 0))
    assert further_picture(state, (5, 0))
    assert not further_picture(state, (6, 0))
    assert not further_picture(state, (5, 1))
    assert further_picture(state, (6, 0))
    with torch.no_grad():
        assert not further_picture(state, (5, 0))
    state.steps = 2
    assert not further_picture(state, (5, 0))


def test_no_depth_and_no_normal_is_left_to_tf32(scene, objects):
    """A host may let torch multiply a GPU's matrices so, and its own rasterizer does not."""

    def blended_besides():
        inputs = DIALECT.unpack(call_of(scene, objects))
        seen = likeness.Seen(inputs, inputs, lambda each: each.splats)
        normals = likeness.MEANINGS["normals in view space"](seen)
        return torch.cat(
            [inputs.splats.features, likeness.widened(inputs).splats.features, normals], 1
        )

    expected = blended_besides()
    with TensorFloat32():
        torch.testing.assert_close(blended_besides(), expected)


def test_a_median_depth_is_made_where_a_host_makes_tensors_elsewhere(scene):
    """On a GPU by default, where the veil's place is computed on the CPU."""

    def last_means(inputs):
        return SimpleNamespace(features=inputs.splats.means[-2:, :1, None])

    seen = likeness.Seen(scene, scene, last_means)
    expected = likeness.MEANINGS["median depth"](seen)
    with torch.device("meta"):
        found = likeness.MEANINGS["median depth"](seen)
    assert torch.equal(found, expected)


@pytest.mark.parametrize("seed", range(12))
def test_no_last_bit_decides_what_a_proofs_chart_looks_like(seed):
    """Two engines that round otherwise draw it alike, through any camera."""
    found = scenes.random_scene(seed, 40)
    channels = torch.rand(40, 5, generator=torch.Generator().manual_seed(seed))
    dialect, call = replace(DIALECT, fork=PLANES), call_of(found, channels, asked=True)
    own = {name: each for name, each in call.arguments.items() if len(each) == 40}
    filled = {**call.arguments, **likeness.chart(own, found.view)}
    drawn = []
    for engine in map(create_engine, ("reference", "cpu")):
        charted = replace(call, arguments=filled)
        draw = partial(engine.rasterize, thresholds=None)
        drawn.append(dialect.answer(charted, dialect.unpack(charted), draw))
    assert [likeness.difference(*each) for each in zip(*drawn, strict=True)] == [""] * 4
    depths = filled["means3D"].double() @ found.view.viewmatrix[:3, 2].double()
    assert depths.sort().values.diff().min() > 1e-5  # of 9, in which float32 is 1e-6 apart
