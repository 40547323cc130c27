"""The cuda engine is used by default only where it has drawn what other engines draw."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import scenes
import torch
from packaging.requirements import Requirement

from fragprune_plugins import engines
from fragprune_plugins.engines.cuda import comparison, driver, kernels, self_check
from fragprune_plugins.engines.cuda.self_check import Verdict, check_in_subprocess, why_not
from fragprune_plugins.errors import EngineError, KernelError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]
AGREES = Verdict("agrees")
FAILS = Verdict("fails", "it crashed")
COULD_NOT_RUN = Verdict("could not run", "CUDA-capable device(s) is/are busy or unavailable")


def a_new_process() -> None:
    self_check._checked.cache_clear()


@pytest.fixture
def checks(kept: Path, monkeypatch: pytest.MonkeyPatch):
    """What each check finds, first to last; those that are left were not made."""
    found: list[Verdict] = []
    a_new_process()
    monkeypatch.setattr(self_check, "_run", lambda device: found.pop(0))
    monkeypatch.setattr(self_check, "_circumstances", lambda device: "here")
    monkeypatch.setattr(driver, "missing", lambda: None)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    yield found
    a_new_process()


# ---- what is remembered ------------------------------------------------------------------------


@pytest.mark.parametrize("verdict", [AGREES, FAILS], ids=lambda verdict: verdict.outcome)
def test_a_verdict_is_remembered_on_the_machine(checks, verdict):
    checks += [verdict, COULD_NOT_RUN]
    expected = None if verdict is AGREES else verdict
    assert why_not("cuda") == expected
    a_new_process()
    assert why_not("cuda") == expected
    assert checks == [COULD_NOT_RUN]


def test_a_check_that_could_not_run_is_made_again_by_the_next_process(checks):
    checks += [COULD_NOT_RUN, AGREES]
    assert [why_not("cuda"), why_not("cuda")] == [COULD_NOT_RUN] * 2
    a_new_process()
    assert why_not("cuda") is None


def test_what_doctor_finds_meanwhile_counts_at_once(checks):
    checks += [COULD_NOT_RUN, FAILS, AGREES]
    assert why_not("cuda") == COULD_NOT_RUN
    for found in (FAILS, AGREES):
        assert check_in_subprocess("cuda") == found
        assert why_not("cuda") == (None if found is AGREES else found)


def test_the_gpu_in_use_is_checked_not_the_first(checks, monkeypatch):
    """The check's process has a current device of its own."""
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    monkeypatch.setattr(self_check, "_run", lambda device: Verdict("fails", device))
    for device in ("cuda", "cuda:1", torch.device("cuda")):
        assert why_not(device) == Verdict("fails", "cuda:1")


def test_a_damaged_memory_is_none(checks, kept):
    checks += [AGREES, FAILS]
    assert why_not("cuda") is None
    a_new_process()
    for path in kept.iterdir():
        path.write_text(path.read_text()[:-3])
    assert why_not("cuda") == FAILS


def test_a_folder_that_cannot_be_written_leaves_it_to_each_process(checks, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv(kernels.CACHE, str(tmp_path / "file" / "folder"))
    checks += [AGREES, AGREES]
    assert why_not("cuda") is None
    a_new_process()
    assert why_not("cuda") is None
    assert checks == []


def test_it_holds_for_gpus_of_one_kind_a_driver_and_this_text(monkeypatch):
    gpu = {"name": "H100", "major": 9, "minor": 0, "multi_processor_count": 132, "uuid": "a"}
    compiler = SimpleNamespace(name="nvrtc", version="13.5")
    monkeypatch.setattr(kernels, "compiler", lambda: compiler)

    def circumstances(version: str = "13050; 580.65", **other) -> str:
        self_check._circumstances.cache_clear()
        monkeypatch.setattr(driver, "version", lambda: version)
        monkeypatch.setattr(
            torch.cuda, "get_device_properties", lambda device: SimpleNamespace(**{**gpu, **other})
        )
        return self_check._circumstances("cuda:1")

    here = circumstances()
    assert circumstances(uuid="b") == here
    assert circumstances("13050; 580.95") != here
    assert circumstances(name="H200") != here
    monkeypatch.setattr(self_check, "_OWN", b"mended")
    assert circumstances() != here
    self_check._circumstances.cache_clear()


# ---- the process -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("program", "verdict"),
    [
        ("", AGREES),
        ("print('begun'); sys.exit('picture is off')", Verdict("fails", "exit code 1")),
        ("print('begun'); print('off', file=sys.stderr); sys.exit(3)", Verdict("fails", "off")),
        ("print('busy', file=sys.stderr); sys.exit(4)", Verdict("could not run", "busy")),
        ("print('begun', flush=True); os.kill(os.getpid(), 11)", Verdict("fails", "code -11")),
        ("os.kill(os.getpid(), 9)", Verdict("could not run", "code -9")),
        ("print('begun', flush=True); time.sleep(60)", Verdict("fails", "no end within 1 s")),
        ("time.sleep(60)", Verdict("could not run", "no end within 1 s")),
    ],
)
def test_crashes_and_hangs_stay_in_a_process_of_their_own(monkeypatch, program, verdict):
    real = subprocess.run
    monkeypatch.setattr(self_check, "PATIENCE", 1 if "sleep" in program else 60)
    command = [sys.executable, "-c", f"import os, sys, time; {program}"]
    monkeypatch.setattr(self_check.subprocess, "run", lambda _, **how: real(command, **how))
    found = self_check._run("cuda")
    assert found.outcome == verdict.outcome
    assert verdict.reason in found.reason


@pytest.mark.parametrize(
    ("found", "status", "said"),
    [
        ([], 0, ""),
        (["sorting: off", "picture: off"], 3, "sorting: off; picture: off"),
        (RuntimeError("CUDA error: illegal address\nCompile with DSA"), 3, "illegal address"),
        (EngineError("driver", "CUDA_ERROR_LAUNCH_FAILED", "success", "Look."), 3, "LAUNCH"),
        (torch.cuda.OutOfMemoryError("out of memory"), 4, "out of memory"),
        (RuntimeError("CUDA error: out of memory\nCompile with DSA"), 4, "out of memory"),
        (EngineError("driver", "CUDA_ERROR_OUT_OF_MEMORY", "success", "Look."), 4, "OUT_OF"),
        (MemoryError(), 4, "MemoryError"),
        (KernelError("kernels", "sm_999", "code", "Update."), 4, "sm_999"),
    ],
    ids=str,
)
def test_what_went_wrong_is_told_from_what_was_untried(monkeypatch, capsys, found, status, said):
    def compare(gpu: object, where: torch.device) -> list:
        if isinstance(found, Exception):
            raise found
        return found

    monkeypatch.setattr(comparison, "compare", compare)
    monkeypatch.setattr(driver, "Driver", object)
    assert comparison.main("cpu") == status
    printed = capsys.readouterr()
    assert printed.out == "begun\n"
    assert said in printed.err
    assert len(printed.err.splitlines()) <= 1


def test_a_gpu_that_is_another_process_s_could_not_be_tried(monkeypatch, capsys):
    def busy(*_: object, **__: object) -> None:
        raise RuntimeError("CUDA error: CUDA-capable device(s) is/are busy or unavailable\nMore")

    monkeypatch.setattr(torch, "zeros", busy)
    assert comparison.main("cpu") == 4
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.strip().endswith("busy or unavailable")


@pytest.mark.parametrize(
    ("cuda", "extra"),
    [
        ("11.8", "fragprune-plugins[cuda12] and nvidia-cuda-nvrtc-cu12,"),
        ("12.8", "fragprune-plugins[cuda12],"),
        ("13.0", "fragprune-plugins[cuda13],"),
    ],
)
def test_the_extra_of_torchs_own_cuda_is_named(monkeypatch, cuda, extra):
    monkeypatch.setattr(torch.version, "cuda", cuda)
    assert extra in driver.remedy()


def test_the_extra_without_a_version_takes_the_bindings_that_torch_brings():
    """Torch 2.10 pins the first, and 2.13 the second: pip would replace torch for another one."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needs = map(Requirement, project["optional-dependencies"]["cuda"])
    (taken,) = (each.specifier for each in needs if each.name == "cuda-bindings")
    assert "12.9.4" in taken
    assert "13.0.3" in taken


# ---- what auto does then -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("verdict", "remedy"),
    [
        (FAILS, "report it"),
        (COULD_NOT_RUN, "run fragprune doctor once while nothing else uses it"),
        (None, r"Install fragprune-plugins\[cuda12\], for torch is for CUDA 12.8"),
    ],
)
def test_auto_refuses_a_gpu_without_it_and_says_what_to_do(checks, monkeypatch, verdict, remedy):
    if verdict is None:  # the extra of another CUDA
        monkeypatch.setattr(driver, "missing", lambda: "no NVRTC library: libnvrtc.so.13")
        monkeypatch.setattr(torch.version, "cuda", "12.8")
    else:
        checks += [verdict]
    with pytest.raises(EngineError, match=remedy) as refused:
        engines.create_engine("auto", "cuda")
    assert (verdict.reason if verdict else "libnvrtc.so.13") in refused.value.found
    assert "--engine reference" in refused.value.remedy
    assert engines.create_engine("reference", "cuda").rasterize(scenes.random_scene(0), None)


def test_a_gpu_where_it_agrees_gets_it(checks, monkeypatch):
    checks += [AGREES]
    monkeypatch.setattr(
        "fragprune_plugins.engines.cuda.engine.CudaEngine", lambda: "the cuda engine"
    )
    assert engines.create_engine("auto", "cuda:1") == "the cuda engine"
