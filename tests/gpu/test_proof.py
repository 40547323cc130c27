"""The cuda engine is used by default only where it has drawn what the oracle draws."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from gpu.emulated import EmulatedDevice

from fragprune_plugins import engines
from fragprune_plugins.engines.cuda import driver, kernels, self_check
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.engines.reference import ReferenceEngine


class WrongPicture(CudaEngine):
    def rasterize(self, inputs, thresholds):
        return super().rasterize(inputs, thresholds * 2)


class WrongSlice(CudaEngine):
    def slice(self, splats, moment):
        return super().slice(splats, replace(moment, timestamp=moment.timestamp + 0.01))


@pytest.mark.parametrize(
    ("engine", "agrees"), [(CudaEngine, True), (WrongPicture, False), (WrongSlice, False)]
)
def test_pictures_slices_and_gradients_are_compared(
    device: EmulatedDevice, monkeypatch: pytest.MonkeyPatch, engine: type, agrees: bool
) -> None:
    made = {"cuda": engine(device), "reference": ReferenceEngine()}
    monkeypatch.setattr(self_check, "create_engine", lambda name, device: made[name])
    assert self_check.agrees("cpu") == agrees


@pytest.fixture
def attempts(kept: Path, monkeypatch: pytest.MonkeyPatch):
    """What each attempt finds, first to last; those that are left were not made."""
    found: list[str | None] = []
    self_check.doubt.cache_clear()
    monkeypatch.setattr(self_check, "attempt", lambda: found.pop(0))
    monkeypatch.setattr(self_check, "_circumstances", lambda: "here")
    yield found
    self_check.doubt.cache_clear()


def a_new_process() -> None:
    self_check.doubt.cache_clear()


def test_a_proof_is_remembered_on_the_machine(attempts: list) -> None:
    attempts += [None, "not again"]
    assert self_check.doubt() is None
    a_new_process()
    assert self_check.doubt() is None
    assert attempts == ["not again"]


def test_a_doubt_is_not_remembered_beyond_its_process(attempts: list, caplog) -> None:
    attempts += ["it crashed", None]
    assert [self_check.doubt(), self_check.doubt()] == ["it crashed"] * 2
    assert caplog.text.count("it crashed") == 1
    a_new_process()
    assert self_check.doubt() is None


def test_another_gpu_toolkit_or_source_is_proved_anew(attempts: list, monkeypatch) -> None:
    attempts += [None, "wrong there"]
    assert self_check.doubt() is None
    a_new_process()
    monkeypatch.setattr(self_check, "_circumstances", lambda: "elsewhere")
    assert self_check.doubt() == "wrong there"


def test_a_folder_that_cannot_be_written_leaves_the_proof_to_each_process(
    attempts: list, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv(kernels.CACHE, str(tmp_path / "file" / "folder"))
    attempts += [None, None]
    assert self_check.doubt() is None
    a_new_process()
    assert self_check.doubt() is None
    assert attempts == []


def test_auto_does_without_a_doubtful_engine(attempts: list, monkeypatch) -> None:
    monkeypatch.setattr(driver, "missing", lambda: None)
    attempts += ["it crashed"]
    assert engines.create_engine("auto", "cuda").name == "reference"


@pytest.mark.parametrize(
    ("program", "doubt"),
    [
        ("", None),
        ("raise SystemExit(3)", "draws something else"),
        ("raise RuntimeError('illegal memory access')", "RuntimeError: illegal memory access"),
        ("import os; os.kill(os.getpid(), 11)", "exit code -11"),
        ("import time; time.sleep(60)", "no picture within 2 s"),
    ],
)
def test_crashes_and_hangs_stay_in_a_process_of_their_own(
    monkeypatch: pytest.MonkeyPatch, program: str, doubt: str | None
) -> None:
    real = subprocess.run
    monkeypatch.setattr(self_check, "PATIENCE", 2 if "sleep" in program else 60)
    monkeypatch.setattr(
        self_check.subprocess, "run", lambda _, **how: real([sys.executable, "-c", program], **how)
    )
    why = self_check.attempt()
    assert why is None if doubt is None else doubt in why
