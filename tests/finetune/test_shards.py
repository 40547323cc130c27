"""Gaussians that are divided among processes: drawn as in one, learned as by one."""

import math
from dataclasses import replace

import pytest
import torch
from elsewhere import TensorFloat32
from finetune import tiny
from finetune.several import CASES, STEPS, learn
from hypothesis import given
from hypothesis import strategies as st
from scenes import with_cov3d

from fragprune_plugins import Portable, RasterInputs, Settings, Splats, ThresholdStore, finetune
from fragprune_plugins.engines import create_engine
from fragprune_plugins.errors import DivergedError, InputError, UsageError
from fragprune_plugins.learning.stage2 import Stage2
from fragprune_plugins.workbench.distributed import (
    ShardedEngine,
    Shards,
    part_of,
    reaching,
    whole_of,
)
from fragprune_plugins.workbench.finetune.resuming import Checkpoints
from fragprune_plugins.workbench.ranks import Ranks

ATTRIBUTES = ("means", "opacities", "scales", "rotations", "sh")
COUNT = 60


def own(ranks, tensor):
    """This process' rows, by the rule that is documented."""
    start, end = (len(tensor) * rank // ranks.size for rank in (ranks.rank, ranks.rank + 1))
    return tensor[start:end]


def leaves(ranks, truncated):
    splats = tiny.random_model(COUNT, degree=3).splats()
    tensors = {name: getattr(splats, name) for name in ATTRIBUTES}
    if truncated:
        tensors["thresholds"] = torch.linspace(0.01, 0.5, COUNT)
    return {k: own(ranks, v).detach().clone().requires_grad_() for k, v in tensors.items()}


def draw(engine, tensors, index):
    """Draw a view, and go backward from all that is differentiable."""
    given = dict(tensors)
    cut = given.pop("thresholds", None)
    stop = None if cut is None else 0.1  # a pruned model has both
    inputs = RasterInputs(tiny.cameras()[index].view(), Splats(**given, sh_degree=3), stop=stop)
    outputs = engine.rasterize(inputs, cut)
    weights = torch.rand(outputs.image.shape, generator=torch.Generator().manual_seed(index))
    loss = (outputs.image * weights).sum() + outputs.invdepth.sum() + 2 * outputs.alpha.mean()
    (loss + 0.3 * outputs.fragments_per_pixel).backward()
    return outputs


def planes(outputs):
    return [outputs.image, outputs.invdepth, outputs.alpha, outputs.fragments_per_pixel]


@pytest.mark.parametrize("truncated", [True, False])
@pytest.mark.parametrize("size", [1, 2, 3])
def test_each_process_draws_its_view_of_all_gaussians_to_the_bit(size, truncated):
    engine = create_engine("cpu")

    def work(ranks):
        tensors = leaves(ranks, truncated)
        outputs = draw(ShardedEngine(engine, ranks), tensors, ranks.rank)
        found = [each.detach() for each in planes(outputs)]
        return found, outputs.radii, {k: v.grad for k, v in tensors.items()}

    parts = learn(size, work) if size > 1 else [work(Ranks())]
    together = leaves(Ranks(), truncated)
    whole = [draw(engine, together, index) for index in range(size)]
    for rank, ((found, radii, _), expected) in enumerate(zip(parts, whole, strict=True)):
        for one, other in zip(found, planes(expected), strict=True):
            assert torch.equal(one, other)
        shown = own(Ranks(rank, size), expected.radii)
        assert torch.equal(radii[radii > 0], shown[radii > 0])
    for name, leaf in together.items():
        gradient = torch.cat([grads[name] for _, _, grads in parts])
        if size == 3 or name == "means":  # sums in another order: a few last bits
            scale = float(leaf.grad.abs().max())
            assert torch.allclose(gradient, leaf.grad, rtol=0, atol=1e-6 * scale), name
        else:
            assert torch.equal(gradient, leaf.grad), name


def test_a_process_whose_gaussians_nobody_sees_takes_part():
    """All lie behind every camera; and one process may have none at all."""

    def work(ranks):
        splats = tiny.random_model(3 if ranks.first else 0).splats()
        means = (splats.means.detach() + 1000.0).requires_grad_()
        engine = ShardedEngine(create_engine("cpu"), ranks)
        inputs = RasterInputs(tiny.cameras()[ranks.rank].view(), replace(splats, means=means))
        outputs = engine.rasterize(inputs, None)
        outputs.image.sum().backward()
        return float(outputs.image.detach().abs().sum()), means.grad, engine.sent

    for rank, (drawn, gradient, sent) in enumerate(learn(2, work)):
        assert drawn == 0
        assert torch.equal(gradient, torch.zeros(3 * (rank == 0), 3))
        assert sent == 0


def test_a_process_without_thresholds_draws_neutral_ones_where_others_have_some():
    """A part's thresholds may all be neutral, and then they are None."""
    engine, cut = create_engine("cpu"), torch.full((COUNT,), 0.3)
    cut[COUNT // 2 :] = 1e-12

    def work(ranks):
        splats = part_of(tiny.random_model(COUNT), ranks, "cpu").splats()
        inputs = RasterInputs(tiny.cameras()[ranks.rank].view(), splats)
        with torch.no_grad():
            return ShardedEngine(engine, ranks).rasterize(
                inputs, own(ranks, cut) if ranks.first else None
            )

    for index, outputs in enumerate(learn(2, work)):
        inputs = RasterInputs(tiny.cameras()[index].view(), tiny.random_model(COUNT).splats())
        assert torch.equal(outputs.image, engine.rasterize(inputs, cut).image)


def test_processes_that_call_with_other_arguments_are_told():
    def work(ranks):
        splats = tiny.random_model(6).splats()
        if not ranks.first:
            splats = replace(splats, means=splats.means.detach().requires_grad_())
        inputs = RasterInputs(tiny.cameras()[0].view(), splats)
        return ShardedEngine(create_engine("cpu"), ranks).rasterize(inputs, None)

    one, other = learn(2, work)
    assert (one.code, other.code) == ("ranks", "ranks")
    assert "process 1 draws Gaussians of another kind" in one.text
    assert "process 0 draws Gaussians of another kind" in other.text


@pytest.mark.parametrize(
    ("changed", "splats"),
    [
        ({"means2d_hook": torch.zeros(6, 3)}, {}),
        ({"sample_offsets": torch.zeros(tiny.SIDE, tiny.SIDE, 2)}, {}),
        *(({"scores": True}, {}), ({}, {"features": torch.ones(6, 2)})),
        ({}, {"scales": torch.ones(6, 2)}),
    ],
)
def test_what_is_not_sent_is_refused(changed, splats):
    drawn = replace(tiny.random_model(6).splats(), **splats)
    inputs = RasterInputs(tiny.cameras()[0].view(), drawn, **changed)
    with pytest.raises(InputError, match="divided among processes"):
        ShardedEngine(create_engine("cpu"), Ranks()).rasterize(inputs, None)


@given(seed=st.integers(0, 10**6), spread=st.floats(0.1, 40), size=st.floats(-6, 3))
def test_every_gaussian_with_a_fragment_is_sent_and_one_far_outside_is_not(seed, spread, size):
    """The engine's own counts are the oracle."""
    model = tiny.random_model(COUNT, seed=seed)
    opacity = torch.linspace(-9, 9, COUNT)[:, None]  # from under 1/255 to nearly 1
    model = replace(model, xyz=spread * model.xyz, scaling=model.scaling + size, opacity=opacity)
    cut = torch.rand(COUNT, generator=torch.Generator().manual_seed(seed)).clamp(1e-6, 1 - 1e-6)
    splats = model.splats()
    if seed % 3 == 1:  # any length, as a host may give them
        splats = replace(splats, rotations=model.rotation)
    if seed % 3 == 2:
        splats = with_cov3d(splats)
    inputs = RasterInputs(tiny.cameras()[seed % 9].view(), splats, counts=True)
    for thresholds in (None, cut):
        sent = set(reaching(inputs, inputs.splats, thresholds).tolist())
        drawn = create_engine("cpu").rasterize(inputs, thresholds).fragments_per_gaussian
        assert set(drawn.nonzero()[:, 0].tolist()) <= sent
        assert not sent & set((inputs.splats.opacities < 0.99 / 255).nonzero()[:, 0].tolist())
    front = replace(inputs, view=tiny.cameras()[0].view())
    means = torch.zeros(COUNT, 3)
    for away in ([0, 0, -1e6], [1e6, 0, 0], [0, -1e6, 0]):  # behind, beside, above
        assert len(reaching(front, replace(splats, means=means + torch.tensor(away)), None)) == 0


def test_what_is_sent_ends_where_fragments_and_rims_end():
    """Round Gaussians on a line across the picture: a sphere is as wide as they are."""
    count = 2000
    model = tiny.random_model(count)
    places = torch.linspace(-8, 8, count)[:, None] * tiny.cameras()[0].rotation[0].float()
    model = replace(
        model, xyz=places, scaling=torch.full((count, 3), -1.0), opacity=torch.full((count, 1), 4.0)
    )
    inputs = RasterInputs(tiny.cameras()[0].view(), model.splats(), counts=True)
    engine = create_engine("cpu")
    drawn = engine.rasterize(inputs, None).fragments_per_gaussian.nonzero()[:, 0]
    for gate in (0.05, 0.3):  # within a rim the gate's surrogate has a gradient
        cut = torch.full((count,), gate, requires_grad=True)
        engine.rasterize(inputs, cut).fragments_per_pixel.backward()
        moved = set(cut.grad.nonzero()[:, 0].tolist())
        assert moved <= set(reaching(inputs, inputs.splats, cut).tolist())
    sent = reaching(inputs, inputs.splats, None)
    assert set(drawn.tolist()) <= set(sent.tolist())
    away, shift = torch.tensor([900.0, -700.0, 400.0]), torch.eye(4)  # far from the world's origin
    shift[3, :3] = -away
    matrices = {k: shift @ getattr(inputs.view, k) for k in ("viewmatrix", "projmatrix")}
    far = replace(inputs, view=replace(inputs.view, **matrices))
    moved_there = replace(inputs.splats, means=inputs.splats.means + away)
    sent = reaching(far, moved_there, None)
    with TensorFloat32():  # where a user lets torch multiply a GPU's matrices so
        assert torch.equal(reaching(far, moved_there, None), sent)
    assert len(drawn) > count / 8
    assert len(sent) - len(drawn) < count / 10  # and few that draw nothing


def learned(model, dataset, settings, ranks=None, checkpoints=None):
    """What a fine-tuning leaves: all Gaussians and thresholds, its curves and its progress."""
    part, engine = model, create_engine("cpu")
    if ranks is not None:
        part, engine = part_of(model, ranks, "cpu"), ShardedEngine(engine, ranks)
    result = finetune(part, dataset, settings, engine=engine, ranks=ranks, checkpoints=checkpoints)
    whole = result.model if ranks is None else whole_of(result.model, ranks)
    return tiny.state(whole), result.curves, result.progress


@pytest.mark.parametrize("case", [case for case in CASES if case != "portable"])
def test_shards_learn_what_one_process_does_with_as_many_views(model, dataset, case):
    settings = CASES[case]
    whole, curves, progress = learned(model, dataset, settings)
    first, second = learn(2, lambda ranks: learned(model, dataset, settings, ranks))
    assert first[1:] == second[1:]
    tensors, points, done = first
    assert len(second[0]["xyz"]) == 0
    for name, tensor in whole.items():  # gradients are summed before the activations: last bits
        assert torch.allclose(tensor, tensors[name], rtol=2e-6, atol=2e-6), name
    assert done.gaussians == progress.gaussians == len(model)
    for found, expected in (
        *((getattr(done, name), getattr(progress, name)) for name in ("speedup", "pressure")),
        *((points[-1].loss, curves[-1].loss), (points[0].loss, curves[0].loss)),
        (points[-1].threshold_median, curves[-1].threshold_median),
    ):
        assert found == pytest.approx(expected, rel=1e-4)


def test_views_that_come_twice_in_a_step_keep_all_together(model, dataset):
    """Steps end in the midst of a pass over the views: some are new when thresholds have opened."""
    few = replace(dataset, train=dataset.train[:5])
    settings = Settings(iterations=STEPS, views_per_step=6, train="opacity")
    whole, _, progress = learned(model, few, settings)
    first, *_ = learn(3, lambda ranks: learned(model, few, settings, ranks))
    assert torch.allclose(first[0]["logits"], whole["logits"], atol=1e-5)
    assert first[2].fragments_before == pytest.approx(progress.fragments_before, rel=1e-6)


def test_an_interrupted_fine_tuning_goes_on_to_the_same_bits(model, dataset, tmp_path):
    settings = Settings(iterations=STEPS, views_per_step=2)
    through = learn(2, lambda ranks: learned(model, dataset, settings, ranks))[0]

    def checkpoints():
        return Checkpoints(tmp_path / "kept", None, 5)

    def stopped(ranks):
        real = Stage2.end

        def end(stage):
            real(stage)
            if stage.steps == 7:
                raise DivergedError("step 7", "a stop", "none", "Go on.")

        Stage2.end = end
        return learned(model, dataset, settings, ranks, checkpoints())

    assert [each.code for each in learn(2, stopped)] == ["not-finite"] * 2
    again, _ = learn(2, lambda ranks: learned(model, dataset, settings, ranks, checkpoints()))
    for name, tensor in through[0].items():
        assert torch.equal(tensor, again[0][name]), name
    assert again[1] == through[1]


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_what_is_not_finite_in_one_part_is_nan_in_all_and_other_gradients_stay(number):
    def work(ranks):
        sound, broken, idle = (torch.ones(3) for _ in range(3))
        sound.grad = torch.full((3,), 0.1 + ranks.rank)
        broken.grad = torch.tensor([1.0, number if ranks.rank == 1 else 2.0, 3.0])
        figures = [[1.0 + ranks.rank, 2.0, 3.0, 4.0]]
        told = Shards(ranks, 3).exchange([sound, broken, idle], figures, 2, [not ranks.first])
        return sound.grad, broken.grad, idle.grad, told

    for rank, (sound, broken, idle, (table, flags)) in enumerate(learn(2, work)):
        assert torch.equal(sound, torch.full((3,), 0.1 + rank))
        assert broken.isnan().any()
        assert idle is None
        assert table[:, 0].tolist() == [1.0, 2.0]
        assert flags == [True]


def test_opacities_low_in_one_part_alone_are_no_reset(model, dataset):
    """A model may be sorted by opacity."""
    opacity = model.opacity.sort(dim=0).values
    opacity[:21] = -6.0
    sorted_ = replace(model, opacity=opacity)
    settings = Settings(iterations=4, views_per_step=3)
    for each in learn(3, lambda ranks: learned(sorted_, dataset, settings, ranks)):
        assert isinstance(each, tuple), each


def test_portable_is_refused(model, dataset):
    engine = ShardedEngine(create_engine("cpu"), Ranks())
    with pytest.raises(UsageError, match="portable, and Gaussians divided"):
        finetune(model, dataset, Settings(goal=Portable()), engine=engine)


def test_parts_hold_every_gaussian_once_and_make_the_whole_again(model):
    store = ThresholdStore.from_falloff(torch.linspace(0.1, 0.9, len(model)))
    store.logits.grad = torch.ones(len(model))
    store.step()

    def work(ranks):
        part = part_of(replace(model, thresholds=store), ranks, "cpu")
        return len(part), tiny.state(whole_of(part, ranks))

    parts = learn(4, work)
    assert [count for count, _ in parts] == [15, 15, 15, 15]
    for name, each in tiny.state(replace(model, thresholds=store)).items():
        assert torch.equal(each, parts[0][1][name]), name
