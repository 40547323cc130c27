"""Several processes learn what one learns that draws as many views a step."""

import os
import socket
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import torch
from finetune import test_shards, tiny
from finetune.several import CASES, STEPS, launch, learn, lose_nan, needs_processes
from hypothesis import given
from hypothesis import strategies as st

from fragprune_plugins import Control, Faster, Pressure, Schedule, Settings, finetune
from fragprune_plugins.errors import RanksError, UsageError
from fragprune_plugins.workbench import ranks as module
from fragprune_plugins.workbench.finetune import loop, processes
from fragprune_plugins.workbench.finetune.resuming import Checkpoints
from fragprune_plugins.workbench.ranks import Ranks, fingerprint, joined, launched, should_print


def learned(model, dataset, settings, ranks=None, moving=()):
    """Everything that a fine-tuning leaves, as plain values."""
    rows = torch.tensor(moving) if moving else None
    result = finetune(model, dataset, settings, engine="cpu", ranks=ranks, relocate=rows)
    return tiny.state(result.model), str(result.curves), result.progress


def require_same(one, other):
    for name, tensor in one[0].items():
        assert torch.equal(tensor, other[0][name]), name
    assert one[1:] == other[1:]


@pytest.mark.parametrize(
    ("size", "case", "moving"),
    [*((2, case, ()) for case in CASES), (2, "all", (41, 3, 5)), (4, "two views each", ())],
)
def test_processes_are_replicas_and_learn_what_one_does_with_as_many_views(
    model, dataset, size, case, moving
):
    settings = CASES[case]
    whole = learned(model, dataset, settings, moving=moving)
    first, *others = learn(size, lambda ranks: learned(model, dataset, settings, ranks, moving))
    for other in others:
        require_same(first, other)
    if settings.views_per_step == 2:  # a + b is b + a
        require_same(whole, first)
    else:  # (a + c) + (b + d) is not ((a + b) + c) + d in its last bits
        require_near(whole, first)


def require_near(one, other):
    """Equal but for the order in which gradients were summed, in float32: a few last bits."""
    for name, tensor in one[0].items():
        assert torch.allclose(tensor, other[0][name], rtol=1e-6, atol=1e-6), name


def test_a_view_more_a_step_costs_no_step_more(model, dataset):
    """Learning rates grow with the square root of the views, and the warm-up shrinks with them."""
    one, four = Settings(iterations=4000), Settings(iterations=1000, views_per_step=4)
    assert (one.warmup, four.warmup) == (2000, 500)
    assert four.rate == 2.0
    for step, other in ((1, 1), (4000, 1000)):
        plan, wide = Schedule(one).at(step), Schedule(four).at(other)
        assert wide.threshold_lr == pytest.approx(2 * plan.threshold_lr)
        assert wide.opacity_lr == pytest.approx(2 * plan.opacity_lr)
        assert wide.decay == pytest.approx(plan.decay)


def test_the_mean_of_one_view_twice_is_that_view(model, dataset):
    twice = replace(dataset, train=[dataset.train[0]])
    one = Settings(iterations=STEPS, train="opacity", goal=Pressure(1e-3))
    two = replace(one, views_per_step=2, threshold_lr=0.05 / 2**0.5, opacity_lr=0.01 / 2**0.5)
    alone, doubled = (learned(model, twice, each) for each in (one, two))
    for name in ("opacity", "logits"):
        assert torch.allclose(alone[0][name], doubled[0][name], atol=1e-5), name


def messages(errors):
    assert {error.code for error in errors} == {"ranks"}
    return [error.text for error in errors]


@pytest.mark.parametrize("what", ["photographs", "checkpoint"])
def test_processes_with_other_files_are_refused_before_a_step(model, dataset, tmp_path, what):
    settings = Settings(iterations=4, views_per_step=2)
    given = {"engine": "cpu", "settings": settings}
    if what == "checkpoint":  # the first process alone sees it
        finetune(model, dataset, checkpoints=Checkpoints(tmp_path / "0", None, 2), **given)

    def work(ranks):
        other = what == "photographs"
        mine = replace(dataset, train=dataset.train[ranks.rank :]) if other else dataset
        own = Checkpoints(tmp_path / str(ranks.rank), None, 2)
        return finetune(model, mine, checkpoints=own, ranks=ranks, **given)

    one, other = messages(learn(2, work))
    assert f"process 1 of 2 with other {what} than process 0" in one
    assert one == other
    assert not (tmp_path / "1").exists()


def test_replicas_that_part_are_noticed_and_named(model, dataset, monkeypatch):
    monkeypatch.setattr(processes, "_COMPARE", 4)

    settings = Settings(iterations=9, views_per_step=2, goal=Control())

    def work(ranks):
        real = torch.optim.Adam.step

        def step(optimizer):
            real(optimizer)
            if ranks.rank == 1:
                optimizer.param_groups[0]["params"][0].data[3] += 1e-6  # one number's last bits

        torch.optim.Adam.step = step
        return learned(model, dataset, settings, ranks)

    one, other = messages(learn(2, work))
    assert "after step 4: process 1 of 2 with other opacity than process 0" in one
    assert one == other


@pytest.mark.parametrize("learned", [learned, test_shards.learned], ids=["replicas", "shards"])
def test_a_gradient_that_is_not_finite_stops_all_with_the_same_words(model, dataset, learned):
    def work(ranks):
        lose_nan(ranks)
        return learned(model, dataset, Settings(iterations=4, views_per_step=2), ranks)

    one, other = learn(2, work)
    assert one == other
    assert one.code == "not-finite"
    assert "stage 2, step 1, view view" in one.text


def test_a_process_that_gives_no_answer_is_not_waited_for_without_end(model, dataset, monkeypatch):
    monkeypatch.setattr(module, "PATIENCE", 0.5)

    def work(ranks):
        real = loop.photometric_loss

        def loss(*args):
            if ranks.rank == 1:
                time.sleep(2)
            return real(*args)

        loop.photometric_loss = loss
        return learned(model, dataset, Settings(iterations=4, views_per_step=2), ranks)

    waited, _ = messages(learn(2, work))
    assert "process 0 of 2: another process ended, or gave no answer for 0.5 s" in waited


@pytest.mark.parametrize(
    ("settings", "found"),
    [
        (Settings(goal=Faster(1.2), views_per_step=2), "disturb each other's measurements"),
        (Settings(views_per_step=3), "3 for 2 processes"),
    ],
)
def test_what_several_processes_cannot_share_is_refused(model, dataset, settings, found):
    with pytest.raises(UsageError, match=found):
        finetune(model, dataset, settings, ranks=Ranks(0, 2))


@given(
    st.lists(st.floats(width=32, allow_nan=False), min_size=1, max_size=20),
    st.integers(0, 19),
    st.integers(0, 31),
)
def test_a_fingerprint_knows_every_bit(numbers, place, bit):
    tensor = torch.tensor(numbers)
    other = tensor.clone()
    other.view(torch.int32)[place % len(numbers)] ^= -(2**31) if bit == 31 else 1 << bit
    assert fingerprint(other) != fingerprint(tensor) == fingerprint(tensor.clone())


def test_a_fingerprint_knows_the_order_across_pieces(monkeypatch):
    monkeypatch.setattr(module, "_PIECE", 3)
    tensor = torch.arange(8, dtype=torch.float32)
    prints = {fingerprint(tensor.roll(k)) for k in range(8)}
    assert len(prints) == 8
    assert isinstance(fingerprint(torch.zeros(0, 3)), int)


@pytest.mark.parametrize(
    ("size", "rank", "expected"),
    [("4", "2", Ranks(2, 4)), ("1", "0", Ranks()), ("", "", Ranks()), ("many", "1", Ranks())],
)
def test_a_launcher_is_known_by_the_environment(monkeypatch, size, rank, expected):
    monkeypatch.setenv("WORLD_SIZE", size)
    monkeypatch.setenv("RANK", rank)
    assert launched() == expected


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


LAST_THREADS = """
import os, sys, torch
from fragprune_plugins.workbench.ranks import joined
with joined(torch.device("cpu")) as ranks:
    tensor = torch.ones(3, requires_grad=True)
    tensor.sum().backward()
    torch.optim.Adam([tensor]).step()  # imports what the group was kept alive by
    ranks.gather(1)
with open(f"{sys.argv[1]}/{ranks.rank}", "w") as file:
    file.write(str(len(os.listdir("/proc/self/task"))))
"""


def test_an_old_torch_is_refused_before_it_can_wait_without_end(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setattr(torch, "__version__", "2.4.1")
    with pytest.raises(RanksError, match=r"torch 2\.4\.1; expected 2\.5"):
        joined(torch.device("cpu")).__enter__()


@needs_processes
def test_no_thread_of_the_group_outlives_it(tmp_path):
    """One that freed a tensor while Python ended aborted the process: to torchrun, a failure.

    Fresh processes: what the group was kept alive by is imported here already.
    """
    meet = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "WORLD_SIZE": "2"}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", LAST_THREADS, str(tmp_path)],
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **meet, "RANK": rank, "OMP_NUM_THREADS": "1"},
        )
        for rank in "01"
    ]
    said = [each.communicate(timeout=200)[1] for each in started]
    assert [each.returncode for each in started] == [0, 0], said
    assert [(tmp_path / rank).read_text() for rank in "01"] == ["1", "1"]


def test_one_of_all_processes_speaks_whoever_asks_first():
    assert sorted(each.left for each in launch(3, lambda _: should_print())) == [False, False, True]
    assert should_print()
