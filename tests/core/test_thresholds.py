import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils._python_dispatch import TorchDispatchMode

from fragprune_plugins.errors import AlignmentError, InputError, SidecarError
from fragprune_plugins.learning.thresholds import ThresholdStore

NONE = (math.nan, math.inf, -math.inf)
OTHER_TYPES = (torch.float64, torch.float16, torch.int32, torch.bool)


class Shadow:
    """A threshold as a row of plain lists: what the store should hold, worked out by hand."""

    def __init__(self, count: int):
        self.rows = [[-30.0, 0.0, 0.0] for _ in range(count)]  # logit, first, second moment
        self.step_count = 0

    def step(self, gradient: list[float], lr: float) -> None:
        """Adam as its paper has it, in float64."""
        self.step_count += 1
        for row, g in zip(self.rows, gradient, strict=True):
            row[1] = 0.9 * row[1] + 0.1 * g
            row[2] = 0.999 * row[2] + 0.001 * g * g
            first = row[1] / (1 - 0.9**self.step_count)
            second = row[2] / (1 - 0.999**self.step_count)
            row[0] -= lr * first / (math.sqrt(second) + 1e-15)

    def replace(self, count: int) -> None:
        self.__init__(count)


def stepped(store: ThresholdStore, gradient: list[float], lr: float) -> None:
    store.logits.grad = torch.tensor(gradient)
    store.step(lr)


NEW = torch.ones(1, dtype=torch.bool)

operation = st.one_of(
    st.tuples(st.just("keep"), st.integers(0, 2**12 - 1)),
    st.tuples(st.just("append"), st.lists(st.integers(0, 99), max_size=4)),
    st.tuples(st.just("orphans"), st.integers(0, 3)),
    st.tuples(
        st.just("rearrange"), st.lists(st.tuples(st.integers(0, 99), st.booleans()), max_size=9)
    ),
    st.tuples(st.just("replace"), st.integers(0, 6)),
    st.tuples(st.just("step"), st.integers(1, 1000)),
)
operations = st.lists(operation, max_size=14)


def apply(store: ThresholdStore, shadow: Shadow, operation: str, argument) -> None:
    n = len(shadow.rows)
    if operation == "keep":
        mask = [bool(argument >> i & 1) for i in range(n)]
        store.keep(torch.tensor(mask, dtype=torch.bool))
        shadow.rows = [row for row, kept in zip(shadow.rows, mask, strict=True) if kept]
    elif operation == "append" and n:
        parents = [i % (n + 1) - 1 for i in argument]
        store.append(len(parents), torch.tensor(parents, dtype=torch.int64))
        shadow.rows += [[-30.0 if i < 0 else shadow.rows[i][0], 0.0, 0.0] for i in parents]
    elif operation == "orphans":
        store.append(argument)
        shadow.rows += [[-30.0, 0.0, 0.0] for _ in range(argument)]
    elif operation == "rearrange" and n:
        origins, fresh = [i % n for i, _ in argument], [new for _, new in argument]
        store.rearrange(
            torch.tensor(origins, dtype=torch.int64), torch.tensor(fresh, dtype=torch.bool)
        )
        old = shadow.rows
        shadow.rows = [
            [old[i][0], 0.0, 0.0] if new else list(old[i])
            for i, new in zip(origins, fresh, strict=True)
        ]
    elif operation == "replace":
        store.replace(argument)
        shadow.replace(argument)
    elif operation == "step":
        gradient = [((argument * (i + 3)) % 17 - 8) / 8 for i in range(n)]
        stepped(store, gradient, 0.05)
        shadow.step(gradient, 0.05)


@given(operations)
def test_rows_and_moments_follow_every_sequence_of_operations(sequence):
    store, shadow = ThresholdStore(5), Shadow(5)
    for operation, argument in sequence:
        apply(store, shadow, operation, argument)
        state = store.state_dict()
        assert len(store) == len(shadow.rows)
        for column, key in enumerate(("logits", "exp_avg", "exp_avg_sq")):
            expected = torch.tensor([row[column] for row in shadow.rows])
            torch.testing.assert_close(state[key], expected, rtol=1e-4, atol=2e-5)


other_changes = st.one_of(
    st.tuples(st.just("open"), st.floats(0.01, 1.0)),
    st.tuples(st.just("load"), st.integers(0, 5)),
    st.tuples(st.just("write"), st.sampled_from([-40.0, -30.0, -29.0, 2.0])),
    st.tuples(st.just("assign"), st.lists(st.sampled_from([-31.0, -2.0]), max_size=4)),
)


def change(store: ThresholdStore, how: str, argument) -> None:
    if how == "open":
        store.open(torch.full((len(store),), argument))
    elif how == "load":
        other = ThresholdStore(argument)
        if argument % 2:
            other.open(torch.full((argument,), 0.5))
        store.load_state_dict(other.state_dict())
    elif how == "write":  # by whoever holds the logits
        with torch.no_grad():
            store.logits[: len(store) // 2 + 1] = argument
    elif how == "assign":
        store.logits = torch.tensor(argument, requires_grad=True)
        store.adam = {}
    else:
        if how == "step":  # rows are opened before they learn
            store.open(torch.full((len(store),), 0.5))
        apply(store, Shadow(len(store)), how, argument)


@given(st.lists(st.one_of(operation, other_changes), max_size=14))
def test_neutral_is_what_a_look_at_every_row_would_say(sequence):
    store = ThresholdStore(3)
    for how, argument in sequence:
        change(store, how, argument)
        assert store.neutral == bool((store.logits <= -30).all()), (how, argument)


class Looks(TorchDispatchMode):
    """Counts reductions of all rows to one answer."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += func is torch.ops.aten.all.default
        return func(*args, **(kwargs or {}))


def test_neutral_looks_at_the_rows_no_more_than_once_a_change():
    store = ThresholdStore(5)
    with Looks() as looks:
        for _ in range(9):
            assert store.neutral
    assert looks.count == 1
    store.open(torch.full((5,), 0.5))
    with Looks() as looks:
        for _ in range(9):
            store.open(torch.full((5,), 0.5))
            stepped(store, [1.0] * 5, 0.05)
            assert not store.neutral
    assert looks.count == 0


def test_neutral_without_version_counters():
    with torch.inference_mode():
        store = ThresholdStore(2)
        assert store.neutral
        store.open(torch.ones(2))
        assert not store.neutral


def test_a_new_store_is_neutral_exactly_and_cannot_drift():
    store = ThresholdStore(7)
    assert store.neutral
    assert len(store) == 7
    # the cutoff -2 ln tau is beyond 2 ln 255, the farthest that any opacity reaches
    assert (-2 * store.values.detach().double().log() > 2 * math.log(255)).all()
    store.values.sum().backward()
    store.logits.grad.mul_(0)  # a threshold that decides nothing gets no gradient from the image
    store.step(0.05)
    assert store.neutral
    assert torch.equal(store.logits.detach(), torch.full((7,), -30.0))


@given(st.lists(st.floats(0.0, 1.0, width=32), min_size=1, max_size=20))
def test_opening_puts_each_threshold_just_below_the_skip_limit(opacities):
    store = ThresholdStore(len(opacities))
    store.open(torch.tensor(opacities)[:, None])
    tau = store.values.detach().double()
    limit = (1 / 255) / torch.tensor(opacities).double().clamp_min(1e-12)
    assert (tau < limit).all()
    drawable = limit < 0.99
    assert (tau[drawable] > limit[drawable] * 0.999).all()
    assert not store.neutral


def test_opening_again_moves_only_rows_that_are_still_neutral():
    store = ThresholdStore(2)
    store.open(torch.tensor([0.5, 0.9]))
    stepped(store, [-1.0, 1.0], 0.05)
    learned = store.logits.detach().clone()
    store.append(1)
    store.open(torch.tensor([0.5, 0.9, 0.2]))
    assert torch.equal(store.logits.detach()[:2], learned)
    assert store.logits[2] > -30


@given(operations)
def test_state_dict_round_trips_bit_for_bit_and_training_goes_on_alike(sequence):
    store, shadow = ThresholdStore(4), Shadow(4)
    for operation, argument in sequence:
        apply(store, shadow, operation, argument)
    other = ThresholdStore(1, lr=0.05)
    other.load_state_dict(store.state_dict())
    for key, value in store.state_dict().items():
        again = other.state_dict()[key]
        assert torch.equal(value, again) if isinstance(value, torch.Tensor) else value == again
    gradient = [0.25] * len(store)
    stepped(store, gradient, 0.03)
    stepped(other, gradient, 0.03)
    assert torch.equal(store.logits, other.logits)


def test_state_dict_is_a_copy():
    store = ThresholdStore(2)
    state = store.state_dict()
    state["logits"].fill_(5.0)
    assert store.neutral


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("short mask", lambda s: s.keep(torch.ones(2, dtype=torch.bool))),
        ("indices as mask", lambda s: s.keep(torch.tensor([0, 1, 2]))),
        ("column mask", lambda s: s.keep(torch.ones(3, 1, dtype=torch.bool))),
        ("parent beyond the end", lambda s: s.append(1, torch.tensor([3]))),
        ("negative parent", lambda s: s.append(1, torch.tensor([-2]))),
        ("too few parents", lambda s: s.append(2, torch.tensor([0]))),
        ("origin beyond the end", lambda s: s.rearrange(torch.tensor([9]), NEW)),
        ("fewer origins than rows", lambda s: s.rearrange(torch.tensor([], dtype=int), NEW)),
        ("opacities of another model", lambda s: s.open(torch.ones(4))),
    ],
)
def test_misuse_is_refused_with_both_counts_and_changes_nothing(name, call):
    store = ThresholdStore(3)
    with pytest.raises(AlignmentError) as caught:
        call(store)
    assert caught.value.where.startswith("ThresholdStore.")
    assert any(digit.isdigit() for digit in caught.value.found + caught.value.expected)
    assert len(store) == 3
    assert store.neutral


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        *(
            case
            for key in ("logits", "exp_avg", "exp_avg_sq")
            for case in (
                *((key, torch.tensor([0, wrong, 0]), rf"{key} .* 1 of 3 rows") for wrong in NONE),
                *((key, torch.zeros(3, dtype=kind), "float32") for kind in OTHER_TYPES),
            )
        ),
        ("exp_avg_sq", torch.tensor([0, 0, -1e-9]), "second moments that are not negative"),
        ("exp_avg", torch.zeros(2), "shapes"),
        ("logits", torch.tensor(0.0), "shapes"),
    ],
)
def test_a_state_that_learning_cannot_have_left_is_refused_and_changes_nothing(key, value, said):
    state, store = ThresholdStore(3).state_dict(), ThresholdStore(3)
    with pytest.raises(SidecarError, match=said):
        store.load_state_dict(state | {key: value})
    assert store.neutral


@given(st.lists(st.sampled_from([-9.0, -1.0, 0.0, 1.0, 9.0]), max_size=30), st.floats(0.05, 40.0))
def test_values_stay_inside_0_and_1_in_float32_however_far_one_learns(gradients, lr):
    store = ThresholdStore(2)
    store.open(torch.tensor([0.5, 0.9]))
    for gradient in gradients:
        stepped(store, [gradient, -gradient], lr)
    values = store.values.detach()
    assert ((values > 0) & (values < 1)).all()
    assert torch.equal(torch.sigmoid(store.state_dict()["logits"]), values)  # as others read it


def test_values_of_a_state_from_elsewhere_stay_inside_too():
    state = ThresholdStore(4).state_dict()
    state["logits"] = torch.tensor([-1e30, -200.0, 20.0, 1e30])
    store = ThresholdStore(0)
    store.load_state_dict(state)
    values = store.values.detach()
    assert ((values > 0) & (values < 1)).all()


def test_a_store_holds_the_thresholds_it_was_given():
    given = torch.tensor([1e-6, 0.01, 0.5, 0.999])
    store = ThresholdStore.from_falloff(given, lr=0.1)
    assert torch.allclose(store.values, given, rtol=1e-5)
    assert store.lr == 0.1
    store.values.sum().backward()
    store.step()
    assert (store.values < given).all()  # it learns on from there
    assert store.steps == 1


@pytest.mark.parametrize(
    "given",
    [
        torch.tensor([0.5, 0.0]),
        torch.tensor([0.5, 1.0]),
        torch.tensor([0.5, math.nan]),
        torch.tensor([[0.5]]),
        torch.tensor([1, 2]),
        [0.5, 0.2],
    ],
)
def test_thresholds_that_are_none_are_refused(given):
    with pytest.raises(InputError, match="falloff in"):
        ThresholdStore.from_falloff(given)


def test_a_limit_of_alpha_is_the_same_alpha_at_every_rim():
    opacities = torch.tensor([[0.05], [0.5], [1.0]])
    store = ThresholdStore.from_alpha(0.04, opacities, lr=0.25)
    assert store.lr == 0.25
    assert torch.allclose(store.values * opacities[:, 0], torch.tensor(0.04))
    faint = ThresholdStore.from_alpha(0.1, torch.tensor([0.0, 0.05, 0.1])).values
    assert ((faint > 0.999) & (faint < 1)).all()
    for none in (0.0, 1.0, math.nan):
        with pytest.raises(InputError):
            ThresholdStore.from_alpha(none, opacities)
    for logits in (-opacities, 2 * opacities, math.nan * opacities):
        with pytest.raises(InputError, match="activated"):
            ThresholdStore.from_alpha(0.04, logits)
