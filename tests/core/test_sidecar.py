from pathlib import Path

import pytest
import torch
from finetune import tiny
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from fragprune_plugins.errors import DivergedError, SidecarError
from fragprune_plugins.files import sidecar
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.workbench.models.formats.ply import write_ply


@pytest.fixture
def trained() -> ThresholdStore:
    store = ThresholdStore(6)
    store.open(torch.linspace(0.1, 0.9, 6))
    for step in range(3):
        store.logits.grad = torch.linspace(-1, 1, 6) * (step + 1)
        store.step(0.05)
    return store


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "point_cloud.ply"
    path.write_bytes(b"ply\nthe host's own bytes")
    return path


def test_what_is_learned_where_a_host_makes_float64_the_default_is_loaded(model):
    torch.set_default_dtype(torch.float64)
    try:
        store = ThresholdStore(2)
        store.append(1)
        store.replace(3)
        store.open(torch.full((3,), 0.5))
        sidecar.save(model, store)
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(sidecar.load(model)[0].logits, store.logits)


@pytest.mark.parametrize(("stop", "rim"), [(None, "hard"), (0.01, "hard"), (0.01, "soft")])
def test_what_is_saved_is_loaded_bit_for_bit(model, trained, stop, rim):
    before, trained.stop, trained.rim = model.read_bytes(), stop, rim
    path = sidecar.save(
        model, trained, adapter="a-host", host_commit="c0ffee", settings={"iterations": 3}
    )
    assert path == model.with_name("point_cloud.fragprune.safetensors")
    assert model.read_bytes() == before
    for rows in (None, 6):
        loaded, info = sidecar.load(model, rows)
        assert loaded.rules == {"stop": stop, "rim": rim}
        for key, value in trained.state_dict().items():
            again = loaded.state_dict()[key]
            assert torch.equal(value, again) if torch.is_tensor(value) else value == again
        assert (info.rows, info.adapter, info.host_commit) == (6, "a-host", "c0ffee")
        assert info.settings == {"iterations": 3}


def test_a_column_of_the_file_counts_more_than_a_sidecar(tmp_path, trained):
    path = tmp_path / "a.ply"
    write_ply(path, tiny.random_model(6))
    assert sidecar.thresholds_of(path, 6) is None
    sidecar.save(path, trained)
    assert torch.equal(sidecar.thresholds_of(path, 6).logits, trained.logits)
    write_ply(path, tiny.cut(tiny.random_model(6), 0.25))  # the sidecar is another file's now
    assert sidecar.thresholds_of(path, 6).values.tolist() == [0.25] * 6


def test_a_sidecar_belongs_to_its_file_and_is_refused_for_a_later_one(model, trained):
    assert not sidecar.belongs(model)
    sidecar.save(model, trained)
    assert sidecar.belongs(model)
    model.write_bytes(model.read_bytes() + b" retrained")
    assert not sidecar.belongs(model)
    with pytest.raises(SidecarError, match="thresholds of another model"):
        sidecar.load(model)


@pytest.mark.parametrize("rows", [0, 1, 5, 7])
def test_thresholds_of_other_rows_are_refused_with_both_counts(model, trained, rows):
    sidecar.save(model, trained)
    with pytest.raises(SidecarError, match=f"thresholds of 6 Gaussian.*; expected {rows}, one"):
        sidecar.load(model, rows)


def bytes_of(change):
    """Break a sidecar by its bytes."""

    def act(path):
        path.write_bytes(change(path.read_bytes()))

    return act


def parts(metadata=(), **tensors):
    """Break a sidecar by some of its tensors, or of its metadata."""

    def act(path):
        with safe_open(path, framework="pt") as file:
            kept = file.metadata() | dict(metadata)
        save_file(load_file(path) | tensors, path, metadata=kept)

    return act


def folder(path):
    path.unlink()
    path.mkdir()


ZERO = torch.zeros(6)
BROKEN = {
    "truncated": bytes_of(lambda data: data[:-5]),
    "empty": bytes_of(lambda data: b""),
    "corrupted header": bytes_of(lambda data: data[:9] + b"\xff\xff" + data[11:]),
    "not safetensors": bytes_of(lambda data: b"PK\x03\x04 some zip"),
    "foreign safetensors": lambda path: save_file({"weight": ZERO}, path),
    "another format": parts({"format": "fragprune-thresholds-999"}),
    "fewer rows than stated": parts(
        logits=torch.ones(4), exp_avg=torch.zeros(4), exp_avg_sq=torch.zeros(4)
    ),
    "not a number": parts(logits=ZERO / 0),
    "a folder": folder,
    "missing": Path.unlink,
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_sidecar_is_one_stated_error(model, trained, how):
    BROKEN[how](sidecar.save(model, trained))
    with pytest.raises(SidecarError) as caught:
        sidecar.load(model, 6)
    assert "\n" not in str(caught.value)
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("rows", "six"), ("settings", "{"), ("settings", "[]"), ("settings", "[" * 100_000)),
        *(("adam_step", "inf"), ("adam_step", "-1")),
        *(("steps", "9" * 5000), ("steps", str(1 << 80))),
    ],
)
def test_metadata_that_are_none_are_refused(model, trained, key, value):
    parts({key: value})(sidecar.save(model, trained))
    with pytest.raises(SidecarError, match="at its metadata"):
        sidecar.load(model, 6)


def test_what_is_not_finite_is_not_written_and_the_old_sidecar_stays(model, trained):
    path = sidecar.save(model, trained)
    before = path.read_bytes()
    with torch.no_grad():
        trained.logits[2] = float("nan")
    with pytest.raises(DivergedError, match=r"thresholds \(1 of 6 rows\)"):
        sidecar.save(model, trained)
    assert path.read_bytes() == before
