"""Which build is opened, and what is said when none can be; header and Python agree."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import fragprune_plugins.native
from fragprune_plugins import constants
from fragprune_plugins.engines import create_engine
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.errors import EngineError
from fragprune_plugins.slicing import splats, structs

HEADER = (Path(fragprune_plugins.native.__file__).parent / "include/fragprune.h").read_text()
needs_native = pytest.mark.skipif(not binding.usable_builds(), reason="no compiled rasterizer here")


@pytest.fixture(autouse=True)
def _decide_anew():
    binding._chosen.cache_clear()
    yield
    binding._chosen.cache_clear()


def test_header_and_python_hold_the_same_constants():
    found = dict(re.findall(r"#define FRAGPRUNE_([A-Z_]+) ([-(0-9][^\n]*)", HEADER))
    assert int(found.pop("API_VERSION")) == binding.API_VERSION
    assert len(found) == 18
    for name, value in found.items():
        assert eval(value) == getattr(splats if name == "MARGINAL_MIN" else constants, name), name


@pytest.mark.parametrize(
    "mirror",
    [
        *(binding.Inputs, binding.Outputs, binding.OutputGrads, binding.InputGrads, binding.Error),
        *(structs.Spacetime, structs.Sliced, structs.SpacetimeGrads, binding.Photometric),
    ],
)
def test_header_and_python_hold_the_same_structs(mirror):
    name = f"fragprune_{re.sub(r'(?<!^)(?=[A-Z])', '_', mirror.__name__).lower()}"
    (body,) = re.findall(rf"typedef struct {name} {{(.*?)}} {name};", HEADER, re.DOTALL)
    body = re.sub(r"/\*.*?\*/", "", body, flags=re.DOTALL)
    declared = re.findall(r"(\w+(?: \w+)?) \*?(\w+)(?:\[\d+\])?;", body)
    fields = ["size"] * issubclass(mirror, binding.Sized) + [name for name, *_ in mirror._fields_]
    assert [field for _, field in declared] == fields


def test_switched_off(monkeypatch):
    monkeypatch.setenv(binding.ENVIRONMENT, "off")
    assert not binding.available()
    assert "switched off" in binding.chosen()
    with pytest.raises(EngineError, match="switched off"):
        create_engine("cpu")
    assert create_engine("auto").name == "reference"


def test_an_absent_file_is_a_reason(monkeypatch):
    monkeypatch.delenv(binding.ENVIRONMENT, raising=False)
    monkeypatch.setattr(binding, "_SUFFIX", ".absent")
    assert not binding.available()
    assert "not installed" in binding.chosen()


def test_a_broken_file_is_a_reason_not_a_crash(monkeypatch, tmp_path):
    for build in binding.usable_builds():
        (tmp_path / f"_cpu_{build}{binding._SUFFIX}").write_bytes(b"not a library")
    monkeypatch.setattr(binding.native, "__file__", str(tmp_path / "__init__.py"))
    assert "cannot be opened" in binding.chosen()


@needs_native
def test_a_build_of_another_interface_is_a_reason_with_both_versions(monkeypatch):
    ours = binding.API_VERSION
    monkeypatch.setattr(binding, "API_VERSION", ours + 1)
    reason = binding.chosen()
    assert f"speaks version {ours}, this package {ours + 1}; reinstall" in reason


def test_an_unknown_build_is_refused(monkeypatch):
    monkeypatch.setenv(binding.ENVIRONMENT, "sse9")
    assert "not one of off, avx512, avx2, baseline" in binding.chosen()


@needs_native
@pytest.mark.parametrize("build", binding.usable_builds())
def test_the_environment_chooses(monkeypatch, build):
    monkeypatch.setenv(binding.ENVIRONMENT, build)
    opened = binding.library()
    assert opened.build == build
    assert opened.lanes == {"baseline": 4, "avx2": 8, "avx512": 16}[build]


@needs_native
def test_the_best_build_is_the_default(monkeypatch):
    monkeypatch.delenv(binding.ENVIRONMENT, raising=False)
    assert binding.library().build == binding.usable_builds()[0]
    assert create_engine("auto").name == "cpu"


@needs_native
def test_a_processor_without_avx_gets_the_baseline(monkeypatch):
    monkeypatch.delenv(binding.ENVIRONMENT, raising=False)
    monkeypatch.setattr(binding, "BUILDS", {"avx512": 1 << 20, "avx2": 1 << 21, "baseline": 0})
    assert binding.library().build == "baseline"


@needs_native
def test_bad_calls_get_a_status_and_a_message():
    calls = binding.library().calls
    error = binding.Error()
    for inputs in (binding.Inputs(), binding.Inputs(width=3, height=3, count=-1)):
        outputs = binding.Outputs()
        status = calls.fragprune_forward(inputs, outputs, None, error)
        assert status != binding.OK
        assert error.message
    stale = binding.Inputs()
    stale.size = 8
    assert calls.fragprune_forward(stale, binding.Outputs(), None, error) != binding.OK
    assert b"version" in error.message
    status = calls.fragprune_backward(None, binding.OutputGrads(), binding.InputGrads(), 1, error)
    assert status != binding.OK
    calls.fragprune_free(None)


@needs_native
def test_only_the_interface_is_exported():
    listing = subprocess.run(
        ["nm", "-D", "--defined-only", binding.library().path], capture_output=True, text=True
    )
    if listing.returncode:
        pytest.skip("no nm")
    ours = {line.split()[-1] for line in listing.stdout.splitlines() if " T " in line}
    declared = set(re.findall(r"FRAGPRUNE_EXPORT \w+ \*?(\w+)\(", HEADER))
    assert {name for name in ours if not name.startswith("_")} == declared


@needs_native
def test_memory_is_returned():
    """A state that nobody freed would grow by 3 MB per turn here."""
    import resource

    import scenes

    from fragprune_plugins.engines.cpu.engine import CpuEngine

    engine = CpuEngine()
    made, _ = scenes.leaves(scenes.random_scene(0, 5000, 300, 200, scale_modifier=0.5))
    grown = 0
    for turn in range(20):
        engine.rasterize(made, None).image.sum().backward()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        if turn == 6:
            grown = peak
    unit = 1 if sys.platform == "darwin" else 1024
    assert (peak - grown) * unit < 20e6
