"""Gaussians that are worth little move to where some are missing, while a model learns."""

from dataclasses import replace

import pytest
import torch
from finetune import tiny
from hypothesis import given
from hypothesis import strategies as st

from fragprune_plugins import Control, Portable, Pressure, Settings, finetune
from fragprune_plugins.engines import create_engine
from fragprune_plugins.errors import InputError, UsageError
from fragprune_plugins.learning.thresholds import MOMENTS, ThresholdStore
from fragprune_plugins.workbench.figures.evaluate import Candidate, psnrs
from fragprune_plugins.workbench.finetune import relocation
from fragprune_plugins.workbench.finetune.relocation import (
    DEEPER,
    PACE,
    SHARE,
    Relocation,
    least,
    split,
)

PARAMETERS = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")


def parameters(model):
    return {name: getattr(model, name).detach().clone() for name in PARAMETERS}


def covariances(scaling, rotation):
    """(N, 3, 3) float64, from the matrices of complex 2x2 spin: a formulation of its own."""
    q = torch.nn.functional.normalize(rotation.double())
    w, x, y, z = (each.to(torch.complex128) for each in q.unbind(1))
    spin = torch.stack([w - 1j * z, -y - 1j * x, y - 1j * x, w + 1j * z], 1).reshape(-1, 2, 2)
    pauli = torch.tensor(
        [[[0, 1], [1, 0]], [[0, -1j], [1j, 0]], [[1, 0], [0, -1]]], dtype=torch.complex128
    )
    turned = torch.einsum("nab,ibc,ndc->niad", spin, pauli, spin.conj())  # U sigma_i U*
    axes = 0.5 * torch.einsum("niab,jba->nji", turned, pauli).real
    sizes = torch.zeros(len(q), 3, dtype=torch.float64)
    sizes[:, : scaling.shape[1]] = scaling.double().exp()
    return torch.einsum("nji,ni,nki->njk", axes, sizes**2, axes)


@given(seed=st.integers(0, 10**6), axes=st.sampled_from([2, 3]))
def test_two_halves_lie_where_the_whole_lay_and_are_as_large_together(seed, axes):
    model = tiny.random_model(8, seed=seed)
    before = parameters(model)
    before["scaling"] = before["scaling"][:, :axes]
    after = {name: each.clone() for name, each in before.items()}
    wholes, others = torch.tensor([5, 1]), torch.tensor([0, 7])
    split(after, wholes, others)
    same = torch.tensor([2, 3, 4, 6])
    for name, each in after.items():
        assert torch.equal(each[same], before[name][same]), name
    for name in ("f_dc", "f_rest", "rotation"):
        for rows in (wholes, others):
            assert torch.equal(after[name][rows], before[name][wholes]), name
    middle = (after["xyz"][wholes] + after["xyz"][others]) / 2
    torch.testing.assert_close(middle, before["xyz"][wholes])
    off = (after["xyz"][wholes] - middle).double()
    assert (off.norm(dim=1) > 0).all()
    spread = covariances(after["scaling"], after["rotation"])[wholes]
    spread = spread + torch.einsum("ni,nj->nij", off, off)
    whole = covariances(before["scaling"], before["rotation"])[wholes]
    torch.testing.assert_close(spread, whole, rtol=1e-4, atol=1e-7)  # float32 positions
    opacity = after["opacity"].sigmoid()[torch.cat([wholes, others])]
    torch.testing.assert_close(opacity, 0.7 * before["opacity"].sigmoid()[wholes].repeat(2, 1))


@pytest.fixture(scope="module")
def lacking(tmp_path_factory):
    """Photographs of four Gaussians, for which our first two stand; the last four are far above."""
    places = torch.tensor([[-0.45, 0, 0], [-0.15, 0, 0], [0.15, 0, 0], [0.45, 0, 0]])
    truth = tiny.round_ones(places, 0.08)
    truth.f_dc[::2] = 1.5
    unseen = torch.tensor([[0.0, -40, 0], [1.0, -40, 0], [2.0, -40, 0], [3.0, -40, 0]])
    mine = tiny.round_ones(torch.cat([places[::2] + 0.15, unseen]), 0.08)
    mine.scaling[:2, 0] = torch.tensor(0.2).log()
    return mine, tiny.dataset_in_memory(tmp_path_factory.mktemp("images"), truth)


def test_what_the_photographs_pull_at_gets_a_twin(lacking):
    mine, dataset = lacking
    engine, settings = create_engine("auto"), Settings(iterations=200, goal=Control())

    def quality(rows):
        result = finetune(mine, dataset, settings, engine=engine, relocate=rows)
        assert len(result.model) == len(mine)
        assert result.relocated == (0 if rows is None else len(rows))
        values = psnrs(Candidate(result.model), dataset.train, engine)[0]
        return sum(values) / len(values), result.model

    alone, _ = quality(None)
    better, model = quality(torch.tensor([4, 3]))
    assert better > alone + 1  # dB; it is 1.6
    assert (model.xyz[[3, 4]].abs() < 1).all()  # they are in the picture now
    assert torch.equal(model.xyz[[2, 5]], mine.xyz[[2, 5]])  # nobody asked for these


def test_rows_move_in_their_order_in_the_first_third():
    moving = Relocation(torch.tensor([5, 3]), tiny.random_model(6).scaling, 20)
    assert [moving.moved(step) for step in (0, 1, 3, 4, 6, 20)] == [0, 0, 0, 1, 2, 2]


def test_what_is_to_go_is_never_split_and_twins_alone_lose_their_moments():
    leaves = parameters(tiny.random_model(6))
    leaves["scaling"][0] -= 3  # a small one is pulled harder for the same pull by its size
    optimizer = torch.optim.Adam([{"params": [p], "name": n} for n, p in leaves.items()])
    model = replace(tiny.random_model(6), **{n: p.requires_grad_() for n, p in leaves.items()})
    for leaf in leaves.values():
        leaf.grad = torch.ones_like(leaf)
    optimizer.step()
    for row, pull in enumerate((1, 2, 9, 1, 1, 1)):  # 2 would be split, but is to go itself
        model.xyz.grad[row] = pull / model.scaling[row].detach().exp().max()
    before = parameters(model)
    store = ThresholdStore(6)
    moving = Relocation(torch.tensor([4, 2]), model.scaling, 20)
    idle = torch.arange(6.0)  # a host's parameter that no loss has moved yet
    with moving.stepping(4, leaves | {"idle": idle}, store, optimizer.state):
        pass
    assert idle.tolist() == [0, 1, 2, 3, 1, 5]
    assert torch.equal(model.f_dc[4], before["f_dc"][1])  # of all that stay 1 is pulled hardest
    for name, leaf in leaves.items():
        same = [0, 2, 3, 5]
        assert torch.equal(leaf[same], before[name][same])
        for moment in MOMENTS:
            state = optimizer.state[leaf][moment]
            assert not state[[1, 4]].any()
            assert state[same].all()
    assert not moving.pull.any()


def test_a_step_is_a_share_of_the_size_but_of_a_few_medians_at_most():
    model = tiny.random_model(5)
    model.scaling.copy_(torch.tensor([1.0, 2.0, 0.5, 9.0, 1.0]).log()[:, None].expand(-1, 3))
    model.scaling[:, 1:] -= 1  # the longest axis counts
    xyz = model.xyz.clone().requires_grad_()
    moving = Relocation(torch.tensor([0]), model.scaling, 100)
    optimizer = torch.optim.Adam([{"params": [xyz], "lr": moving.rate}], eps=1e-15)
    xyz.grad = torch.randn(5, 3)
    of = {"xyz": xyz, "scaling": model.scaling}, ThresholdStore(5), optimizer.state
    with moving.stepping(1, *of):
        optimizer.step()
    moved = (xyz.detach() - model.xyz).abs()  # Adam's first step is the rate, whatever pulls
    expected = PACE * torch.tensor([1.0, 2.0, 0.5, 3.0, 1.0])
    torch.testing.assert_close(moved, expected[:, None].expand(-1, 3), atol=2e-6, rtol=1e-4)


@pytest.mark.parametrize(
    ("goal", "smaller"), [(Pressure(1e-4), True), (Control(), False), (Portable(), False)]
)
def test_area_has_a_price_while_gaussians_move_and_cutoffs_learn(
    lacking, monkeypatch, goal, smaller
):
    mine, dataset = lacking
    settings, engine = Settings(iterations=60, goal=goal), create_engine("auto")

    def sizes():
        return finetune(mine, dataset, settings, engine=engine, relocate=torch.tensor([4]))

    priced = sizes().model.scaling
    monkeypatch.setattr(relocation, "COMPACT", 0.0)
    free = sizes().model.scaling
    assert (priced.sum() < free.sum()) == smaller
    assert torch.equal(priced, free) != smaller


@pytest.mark.parametrize("what", ["in no picture", "surfels"])
def test_what_has_no_area_pays_for_none(lacking, what):
    mine, dataset = lacking
    if what == "surfels":
        mine = replace(mine, scaling=mine.scaling[:, :2].contiguous())
    else:
        mine = replace(mine, xyz=mine.xyz - torch.tensor([0.0, 0.0, 100.0]))
    result = finetune(mine, dataset, Settings(iterations=10), relocate=torch.tensor([4]))
    assert result.progress.steps == 10


@pytest.mark.parametrize(
    "rows",
    [[0, 1, 2, 3], [4, 4], [6], [-1], [4.0], [True, *[False] * 5], [[4]]],
    ids=["more than half", "twice", "beyond", "negative", "float", "mask", "table"],
)
def test_rows_that_are_none_are_refused(lacking, rows):
    mine, dataset = lacking
    with pytest.raises(InputError, match="relocate"):
        finetune(mine, dataset, Settings(iterations=3), relocate=torch.tensor(rows))


@pytest.mark.parametrize(
    ("settings", "filtered"),
    [
        ({"train": "opacity"}, False),
        ({"dropout": 0.1}, False),
        ({"itself": True}, False),
        ({}, True),
    ],
)
def test_where_nothing_can_move_it_is_refused(lacking, settings, filtered):
    mine, dataset = lacking
    mine = replace(mine, filter_3d=torch.full((len(mine), 1), 0.01)) if filtered else mine
    with pytest.raises(UsageError, match="3D filter" if filtered else "relocate"):
        finetune(mine, dataset, Settings(iterations=3, **settings), relocate=torch.tensor([4]))


@pytest.mark.parametrize("count", [0, 1, 6, 100])
def test_the_least_of_the_scores_can_be_spared(count):
    scores = torch.randperm(count).float()
    rows = least(scores)
    assert len(rows) == int(SHARE * count)
    assert scores[rows].tolist() == list(range(len(rows)))


def test_a_twin_has_the_cutoff_of_the_whole(lacking):
    mine, dataset = lacking
    cut = tiny.cut(mine, torch.tensor([0.3, 0.4, 0.5, 0.6, 0.7, 0.8]))
    fixed = Settings(iterations=10, goal=Pressure(1e-4), threshold_lr=0.0)
    result = finetune(cut, dataset, fixed, relocate=torch.tensor([3]))
    found = result.model.falloff
    assert found[3] in found[:2]
    others = [0, 1, 2, 4, 5]
    torch.testing.assert_close(found[others], cut.falloff[others])


@pytest.mark.parametrize("goal", [Pressure(), Pressure(1e-4), Control()])
def test_the_default_pressure_alone_is_higher(lacking, goal):
    mine, dataset = lacking
    settings = Settings(iterations=10, goal=goal)
    usual = finetune(mine, dataset, settings).progress.pressure
    higher = finetune(mine, dataset, settings, relocate=torch.tensor([3])).progress.pressure
    assert higher == pytest.approx(usual * (DEEPER if goal == Pressure() else 1))
