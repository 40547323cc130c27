"""A fine-tuning that was cut off goes on, and ends with the same bits as one that was not."""

import json
from unittest.mock import Mock

import pytest
import torch
from finetune import tiny
from PIL import Image
from safetensors.torch import save_file

from fragprune_plugins import Control, Faster, Fewer, Portable, Pressure, finetune, load_dataset
from fragprune_plugins.errors import CheckpointError, DivergedError, OutputError
from fragprune_plugins.learning import schedule
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.workbench.finetune import loop, resuming
from fragprune_plugins.workbench.finetune.resuming import Checkpoints

STEPS = 12


class Cut(BaseException):
    """What nothing catches, as nothing catches a kill."""


def run(model, dataset, settings, path=None, *, cut=None, monkeypatch=None, tell=None, **options):
    """Fine-tune, with a checkpoint every third step; ``cut`` ends it in the midst of that step."""
    kept = None if path is None else Checkpoints(path, None, 3, tell or (lambda _: None))
    options |= {"engine": "cpu", "checkpoints": kept}
    if cut is None:
        return finetune(model, dataset, settings, **options)
    with monkeypatch.context() as patch:
        tiny.at_loss(patch, cut, Cut)
        with pytest.raises(Cut):
            finetune(model, dataset, settings, **options)
    return None


def require_same(one, other):
    first, second = tiny.state(one.model), tiny.state(other.model)
    assert first.keys() == second.keys()
    for name, each in first.items():
        assert torch.equal(each, second[name]), name
    assert str(one.curves) == str(other.curves)  # also where a figure is NaN
    assert one.progress == other.progress


def warming_up(patch):
    """Thresholds open after 8 of 12 steps."""
    patch.setattr(schedule, "_LEARNING_STEPS", 4)


CASES = {
    **{"all": {}, "moving": {}, "warm-up": {}, "dropout": {"dropout": 0.2}},
    "opacity": {"train": "opacity", "goal": Pressure(1e-3)},
    "target": {"train": "appearance", "goal": Fewer(1.5)},
    "control": {"goal": Control(), "seed": 3},
    "portable": {"goal": Portable()},
    "target time": {"goal": Faster(1.2)},
}
PREPARED = {"warm-up": warming_up, "target time": tiny.exact_clock}


@pytest.mark.parametrize("case", CASES)
def test_cut_off_it_ends_as_never_cut(model, dataset, tmp_path, monkeypatch, case):
    settings = Settings(iterations=STEPS, **CASES[case])
    if case in PREPARED:
        PREPARED[case](monkeypatch)
    moving = {"relocate": torch.tensor([41, 3, 5]) if case == "moving" else None}
    path, told = tmp_path / "out.fragprune-unfinished", []
    whole = run(model, dataset, settings, **moving)
    given = {"tell": told.append, **moving}
    for cut in (2, 5, 8):  # before a checkpoint, and after one or two more
        run(model, dataset, settings, path, cut=cut, monkeypatch=monkeypatch, **given)
    result = run(model, dataset, settings, path, **given)
    assert [line.split(",")[0] for line in told] == [
        f"resuming at step {step} of {STEPS}" for step in (3, 9)
    ]
    assert result.resumed_at == 9
    require_same(whole, result)


def test_photographs_are_read_once_and_a_changed_one_is_noticed(tmp_path, monkeypatch):
    data, _, model = tiny.scene(tmp_path)
    dataset, read, digest = load_dataset(data), [], resuming.digest
    monkeypatch.setattr(resuming, "digest", lambda path: read.append(path) or digest(path))

    def asked():
        return resuming.configuration(model, dataset, Settings(), "cpu")["photographs"]

    first = asked()
    assert asked() == first
    assert len(read) == len(dataset.train) + len(dataset.test)
    read[0].write_bytes(read[0].read_bytes() + b"0")
    assert asked() != first


@pytest.mark.parametrize("mode", ["RGBA", "RGB"])
def test_dropped_alpha_is_noticed_where_there_is_some(tmp_path, mode):
    data, _, model = tiny.scene(tmp_path)
    for path in (data / "images").iterdir():
        with Image.open(path) as picture:
            picture.convert(mode).save(path)
    one, other = (
        resuming.configuration(model, load_dataset(data, opaque=opaque), Settings(), "cpu")
        for opaque in (True, False)
    )
    assert (one != other) == (mode == "RGBA")


@pytest.fixture(scope="module")
def unfinished(model, dataset, tmp_path_factory):
    """The checkpoint of a fine-tuning of ``STEPS`` steps that was cut off."""
    path = tmp_path_factory.mktemp("cut") / "out.fragprune-unfinished"
    with pytest.MonkeyPatch.context() as patch:
        run(model, dataset, Settings(iterations=STEPS), path, cut=5, monkeypatch=patch)
    return path


@pytest.mark.parametrize(
    ("named", "changed"),
    [
        ("goal", {"goal": Pressure(1e-3)}),
        ("seed, train", {"seed": 1, "train": "opacity"}),
        ("schedule", {}),
        ("loss", {}),
        ("model", {}),
        ("photographs", {}),
        ("thresholds", {}),
    ],
)
def test_another_configuration_is_refused_and_named(
    model, truth, dataset, unfinished, tmp_path, monkeypatch, named, changed
):
    settings, options, before = Settings(iterations=STEPS, **changed), {}, unfinished.read_bytes()
    if named == "schedule":  # a caller's own
        options["schedule"] = Schedule(settings, warmup=6)
    elif named == "loss":  # other code gives other last bits
        monkeypatch.setattr(loop, "code_for", lambda _: "another")
    elif named == "model":
        model = truth
    elif named == "photographs":
        dataset = tiny.dataset_in_memory(tmp_path, tiny.random_model(seed=3))
    elif named == "thresholds":
        model = tiny.cut(model, 0.1)
    with pytest.raises(CheckpointError, match=f"with other {named};"):
        run(model, dataset, settings, unfinished, **options)
    assert unfinished.read_bytes() == before


def tensors(change):
    """Spoil a checkpoint by replacing some of its tensors; None drops one."""

    def spoil(path):
        known, values = resuming.read(path, "cpu")
        given = known | change(known)
        Checkpoints(path).save({k: v for k, v in given.items() if v is not None}, values)

    return spoil


def value(name, word):
    """Spoil a checkpoint by a value that is another one's, or none."""

    def spoil(path):
        known, values = resuming.read(path, "cpu")
        *outer, inner = name.split(".")
        (values[outer[0]] if outer else values)[inner] = word
        Checkpoints(path).save(known, values)

    return spoil


def not_finite(path):
    known, values = resuming.read(path, "cpu")
    known["exp_avg.opacity"][3] = torch.nan
    save_file(known, path, metadata={"format": resuming.FORMAT, "values": json.dumps(values)})


BROKEN = {
    "not a number": not_finite,
    "cut off": lambda path: path.write_bytes(path.read_bytes()[:-9]),
    "empty": lambda path: path.write_bytes(b""),
    "foreign": lambda path: save_file({"logits": torch.zeros(3)}, path),
    "a part is missing": tensors(lambda _: {"model.opacity": None}),
    "other rows": tensors(lambda _: {"model.opacity": torch.zeros(3, 1)}),
    "fewer thresholds": tensors(
        lambda known: {key: known[key][:5] for key in ("logits", "exp_avg", "exp_avg_sq")}
    ),
    "doubles": tensors(lambda known: {"exp_avg": known["exp_avg"].double()}),
    "words for numbers": value("done", "many"),
    "more steps than asked for": value("done", 1000),
    **{
        f"{name}: {word}": value(name, word)
        for name, word in [
            *(("adam_step", []), ("seconds", []), ("steps", "x"), ("steps", -1)),
            *(("_open", None), ("_median", {}), ("_held", 3), ("pressure.observe", 3)),
        ]
    },
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_checkpoint_is_stated(model, dataset, unfinished, tmp_path, how):
    path = tmp_path / "out.fragprune-unfinished"
    path.write_bytes(unfinished.read_bytes())
    BROKEN[how](path)
    with pytest.raises(CheckpointError) as caught:
        run(model, dataset, Settings(iterations=STEPS), path)
    assert "--again" in caught.value.remedy


def test_a_full_disk_costs_the_checkpoint_not_the_training(model, dataset, tmp_path, monkeypatch):
    full = OutputError("x", "cannot be written (No space left on device)", "a place", "Free it.")
    told = []
    monkeypatch.setattr(resuming, "replacing", Mock(side_effect=full))
    result = run(model, dataset, Settings(iterations=4), tmp_path / "out", tell=told.append)
    assert result.progress.steps == 4
    assert "no checkpoint was written" in told[0]
    assert "No space left" in told[0]


def test_what_is_not_finite_takes_no_checkpoints_place(tmp_path):
    """A moment can overflow where gradients and parameters are finite."""
    checkpoints = Checkpoints(tmp_path / "x")
    good, bad = torch.ones(3), torch.tensor([1.0, torch.inf, 1.0])
    checkpoints.save({"exp_avg_sq.opacity": good, "curves": bad * torch.nan}, {"done": 4})
    before = checkpoints.path.read_bytes()
    with pytest.raises(DivergedError, match=r"exp_avg_sq\.opacity \(1 of 3 rows\)"):
        checkpoints.save({"exp_avg_sq.opacity": bad}, {"done": 5})
    assert checkpoints.path.read_bytes() == before


def test_time_decides_when_a_checkpoint_is_due(tmp_path):
    assert Checkpoints(tmp_path / "x", seconds=0.0).due(1)
    assert not Checkpoints(tmp_path / "x", seconds=3600.0).due(1)
    assert not Checkpoints(tmp_path / "x", seconds=None).due(1)
    third = Checkpoints(tmp_path / "x", None, 3)
    assert [step for step in range(1, 8) if third.due(step)] == [3, 6]
