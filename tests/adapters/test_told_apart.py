"""A host is known by what it does otherwise than its relatives; seams are the kit's to change."""

import pytest
from miniatures.light_gaussian import LightGaussianHost
from miniatures.mcmc import MCMCHost
from miniatures.mini_splatting import MiniSplattingHost
from miniatures.mip_splatting import MipHost
from miniatures.rain_gs import RainHost
from miniatures.rt_4dgs import RT4DGSHost
from miniatures.runs import edit, written
from miniatures.surfels import SurfelHost

from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.stand_ins import runs_here
from fragprune_plugins.testing.conformance import found_adapter

RENDERER = "gaussian_renderer/__init__.py"
MODEL = "scene/gaussian_model.py"


@pytest.mark.parametrize(
    ("adapter", "host", "file", "old", "new", "found"),
    [
        ("2dgs", SurfelHost, RENDERER, "radii, allmap = Gauss", "radii = Gauss", "gives 2 values"),
        ("light-gaussian", LightGaussianHost, RENDERER, "f_count", "f_counts", "f_counts"),
        ("mcmc", MCMCHost, "utils/reloc_utils.py", "compute_relocation", "another", "compute_rel"),
        ("mip-splatting", MipHost, RENDERER, "subpixel_offset=", "offset=", "kernel_size, offset"),
        ("mip-splatting", MipHost, MODEL, "compute_3D_filter", "compute", "no compute_3D_filter"),
        ("mip-splatting", MipHost, MODEL, "grads_abs", "absolute", "absolute"),
        ("mip-splatting", MipHost, RENDERER, "means2D=", "view2gaussian=0, means2D=", "view2gauss"),
        ("rain-gs", RainHost, RENDERER, "low_pass=low_pass,\n", "", "takes what hosts share"),
        ("rain-gs", RainHost, MODEL, "divide_ratio", "ratio", "no divide_ratio"),
        ("rain-gs", RainHost, "scene/__init__.py", "args_dict", "options", "no args_dict"),
    ],
)
def test_a_changed_host_is_refused_by_what_changed(adapter, host, file, old, new, found, tmp_path):
    edit(written(host, tmp_path) / file, old, new)
    match = found_adapter(adapter).match(HostRepo(tmp_path))
    errors = [each.found for each in match.findings if each.level == "error"]
    assert any(found in error for error in errors), errors


@pytest.mark.parametrize(
    ("adapter", "host", "script"),
    [
        ("light-gaussian", LightGaussianHost, "distill_train.py"),
        ("mini-splatting", MiniSplattingHost, "ms_d/train.py"),
    ],
)
def test_a_missing_script_is_named(adapter, host, script, tmp_path):
    (written(host, tmp_path) / script).unlink()
    match = found_adapter(adapter).match(HostRepo(tmp_path))
    assert f"no {script}" in [each.found for each in match.findings if each.level == "error"]


@pytest.mark.parametrize("compiler", [None, "/usr/local/cuda"])
@pytest.mark.parametrize("gpu", [False, True])
@pytest.mark.parametrize(
    ("adapter", "host", "own", "answered"),
    [
        ("rain-gs", RainHost, "submodules", "simple_knn"),
        ("rt-4dgs", RT4DGSHost, "gaussian_renderer", "pointops2_cuda"),
    ],
)
def test_a_rasterizer_of_its_own_stays_where_it_can_be_compiled(
    adapter, host, own, answered, tmp_path, monkeypatch, compiler, gpu
):
    monkeypatch.setattr("torch.utils.cpp_extension.CUDA_HOME", compiler)
    monkeypatch.setattr("torch.cuda.is_available", lambda: gpu)
    dialect = found_adapter(adapter).dialect(HostRepo(written(host, tmp_path)))
    assert runs_here(dialect, own) == bool(compiler and gpu)
    assert runs_here(dialect, "torch")
    assert not runs_here(dialect, answered)
