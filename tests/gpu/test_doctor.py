"""What ``fragprune doctor`` says about GPUs, and what it builds for them."""

import json

import pytest
import torch
from click.testing import CliRunner

from fragprune_plugins import engines
from fragprune_plugins.engines.cuda import driver, kernels, self_check
from fragprune_plugins.engines.cuda.self_check import Verdict
from fragprune_plugins.errors import EngineError
from fragprune_plugins.workbench.commands import cli
from fragprune_plugins.workbench.doctor import work


class Compiler:
    """Makes up images."""

    name, version, architectures = "made-up", "1.0", (75, 90)

    def compile(self, source: str, macros: dict[str, int], target: str) -> kernels.Image:
        if source == "unblend" and target == "sm_75":
            raise kernels.Unavailable("it does not like it")
        log = (
            "Compiling entry function 'fp_a' for 'sm_90'\n 0 bytes stack frame, "
            "4 bytes spill stores, 8 bytes spill loads\n Used 47 registers, 96 bytes smem"
        )
        return kernels.Image(b"code", log)


def invoke(*arguments: str) -> tuple[int, dict]:
    done = CliRunner().invoke(cli, ["doctor", "--json", *arguments])
    return done.exit_code, json.loads(done.stdout)


def test_kernels_are_built_beforehand_and_kept(kept, monkeypatch):
    monkeypatch.setattr(kernels, "compiler", Compiler)
    status, first = invoke("--build-cuda", "90, sm_100")
    assert status == 0
    assert first["compiler"] == "made-up 1.0"
    assert {(k["target"], k["kept"]) for k in first["kernels"]} == {
        ("sm_90", False),
        ("compute_90", False),
    }
    assert (first["kernels"][0]["registers"], first["kernels"][0]["spills"]) == (47, 12)
    assert all(k["kept"] for k in invoke("--build-cuda", "90")[1]["kernels"])


def test_what_cannot_be_built_is_an_error(kept, monkeypatch):
    monkeypatch.setattr(kernels, "compiler", Compiler)
    status, said = invoke("--build-cuda", "75")
    assert (status, said["error"]["code"]) == (1, "engine")
    assert "does not like it" in said["error"]["found"]
    assert invoke("--build-cuda", "ampere")[0] == 2


def test_it_says_why_there_is_no_engine_for_gpus(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setenv(kernels.ENVIRONMENT, "off")
    gpu = invoke()[1]["gpu"]
    assert (gpu["available"], gpu["agrees"]) == (False, None)
    assert "switched off" in gpu["reason"]
    for name in ("cuda", "auto"):
        with pytest.raises(EngineError, match="switched off"):
            engines.create_engine(name, "cuda")


@pytest.mark.parametrize(
    ("verdict", "status", "agrees", "said"),
    [
        (Verdict("agrees"), 0, True, None),
        (Verdict("fails", "no end within 300 s"), 1, False, "report it"),
        (Verdict("could not run", "the device is busy"), 1, None, "compute mode is exclusive"),
    ],
    ids=lambda value: getattr(value, "outcome", ""),
)
def test_a_gpu_is_checked_each_time_and_what_failed_told_from_what_could_not_run(
    monkeypatch, verdict, status, agrees, said
):
    monkeypatch.setattr(driver, "missing", lambda: None)
    gpu = {"available": True, "device": "A GPU", "capability": "9.0", "compiler": "nvrtc 13.0"}
    monkeypatch.setattr(work, "_cuda_engine", lambda: gpu | {"kept": "cache", "reason": None})
    monkeypatch.setattr(self_check, "check_in_subprocess", lambda device: verdict)
    code, report = invoke()
    assert (code, report["gpu"]["agrees"]) == (status, agrees)
    assert verdict.reason in report["gpu"]["check"]
    text = CliRunner().invoke(cli, ["doctor"]).output
    assert said is None or said in text
    line = "cuda engine: A GPU, compute capability 9.0, kernels by nvrtc 13.0, kept in cache: "
    assert f"{line}{verdict}\n" in text


@pytest.mark.parametrize(
    ("cuda", "remedy"),
    [
        (None, "Install torch for CUDA."),
        ("13.0", "Install fragprune-plugins[cuda13], for torch is for CUDA 13.0."),
    ],
)
def test_what_is_missing_is_a_sentence_with_what_to_do(monkeypatch, cuda, remedy):
    monkeypatch.setattr(torch.version, "cuda", cuda)
    monkeypatch.setenv(kernels.ENVIRONMENT, "off")
    lines = CliRunner().invoke(cli, ["doctor"]).output.splitlines()
    (line,) = [each for each in lines if each.startswith("cuda engine: ")]
    assert "switched off" in line
    assert line.endswith(f"For an NVIDIA GPU: {remedy}")
    assert not [each for each in lines if "None" in each or "True" in each or "False" in each]
