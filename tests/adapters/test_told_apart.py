"""A host is known by what it does otherwise than its relatives; seams are the kit's to change."""

import pytest
from miniatures.hosts import HOSTS
from miniatures.runs import edit, written

from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.stand_ins import runs_here
from fragprune_plugins.testing.conformance import found_adapter

RENDERER = "gaussian_renderer/__init__.py"
MODEL = "scene/gaussian_model.py"


@pytest.mark.parametrize(
    ("adapter", "file", "old", "new", "found"),
    [
        ("2dgs", RENDERER, "radii, allmap = Gauss", "radii = Gauss", "gives 2 values"),
        ("4dgaussians", "train.py", '("fine", ', '("other", ', "no phase fine in train.py"),
        ("4dgaussians", "train.py", "_{stage}_", "_", "no checkpoints of a phase in train.py"),
        ("vanilla-3dgs", "train.py", ".update_learning_rate(", ".warm(", "no update_learning_rate"),
        ("vanilla-3dgs", MODEL, "state_dict(),\n", "state_dict(), 0,\n", "capture gives 13"),
        ("light-gaussian", RENDERER, "f_count", "f_counts", "f_counts"),
        ("mcmc", "utils/reloc_utils.py", "compute_relocation", "another", "compute_rel"),
        ("mip-splatting", RENDERER, "subpixel_offset=", "offset=", "kernel_size, offset"),
        ("mip-splatting", MODEL, "compute_3D_filter", "compute", "no compute_3D_filter"),
        ("mip-splatting", RENDERER, "means2D=", "view2gaussian=0, means2D=", "view2gauss"),
        ("rain-gs", RENDERER, "low_pass=low_pass,\n", "", "takes what hosts share"),
        ("rain-gs", MODEL, "divide_ratio", "ratio", "no divide_ratio"),
        ("rain-gs", "scene/__init__.py", "args_dict", "options", "no args_dict"),
        (
            "vanilla-3dgs",
            "scene/__init__.py",
            "self.gaussians.save_ply(self._ply(iteration))",
            "os.rename(self.gaussians.save_ply('.tmp'), self._ply(iteration))",
            "Scene.save renames the PLY that it saves",
        ),
    ],
)
def test_a_changed_host_is_refused_by_what_changed(adapter, file, old, new, found, tmp_path):
    edit(written(HOSTS[adapter], tmp_path) / file, old, new)
    match = found_adapter(adapter).match(HostRepo(tmp_path))
    errors = [each.found for each in match.findings if each.level == "error"]
    assert any(found in error for error in errors), errors


def test_a_checkpoint_of_further_values_is_not_vanillas(tmp_path):
    path = written(HOSTS["vanilla-3dgs"], tmp_path) / MODEL
    edit(path, "state_dict(),\n", "state_dict(), self.seed,\n")
    edit(path, ") = model_args", "seed) = model_args")
    match = found_adapter("vanilla-3dgs").match(HostRepo(tmp_path))
    errors = [each.found for each in match.findings if each.level == "error"]
    assert errors == ["capture gives 13 values"]


@pytest.mark.parametrize(
    ("adapter", "script"),
    [("light-gaussian", "distill_train.py"), ("mini-splatting", "ms_d/train.py")],
)
def test_a_missing_script_is_named(adapter, script, tmp_path):
    (written(HOSTS[adapter], tmp_path) / script).unlink()
    match = found_adapter(adapter).match(HostRepo(tmp_path))
    assert f"no {script}" in [each.found for each in match.findings if each.level == "error"]


@pytest.mark.parametrize("compiler", [None, "/usr/local/cuda"])
@pytest.mark.parametrize("gpu", [False, True])
@pytest.mark.parametrize(
    ("adapter", "own", "answered"),
    [("rain-gs", "submodules", "simple_knn"), ("rt-4dgs", "gaussian_renderer", "pointops2_cuda")],
)
def test_a_rasterizer_of_its_own_stays_where_it_can_be_compiled(
    adapter, own, answered, tmp_path, monkeypatch, compiler, gpu
):
    extension = pytest.importorskip("torch.utils.cpp_extension")
    monkeypatch.setattr(extension, "CUDA_HOME", compiler)
    monkeypatch.setattr("torch.cuda.is_available", lambda: gpu)
    dialect = found_adapter(adapter).dialect(HostRepo(written(HOSTS[adapter], tmp_path)))
    assert runs_here(dialect, own) == bool(compiler and gpu)
    assert runs_here(dialect, "torch")
    assert not runs_here(dialect, answered)
