"""A host is known by what it does otherwise than its relatives; seams are the kit's to change."""

import pytest
from miniatures.light_gaussian import LightGaussianHost
from miniatures.mcmc import MCMCHost
from miniatures.mini_splatting import MiniSplattingHost
from miniatures.mip_splatting import MipHost
from miniatures.rain_gs import RainHost
from miniatures.runs import edit, written
from miniatures.surfels import SurfelHost

from fragprune_plugins.hosts.source import HostRepo
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
