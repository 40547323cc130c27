"""The demo's host has vanilla 3DGS's public shape, read from its source: names and parameters."""

import ast

import pytest

from fragprune_plugins.workbench.demo.demo import HOST

ROOT = HOST.parent

FUNCTIONS = {
    "train.py": {
        "training": "dataset opt pipe testing_iterations saving_iterations "
        "checkpoint_iterations checkpoint debug_from",
        "prepare_output_and_logger": "args",
        "training_report": None,
    },
    "gaussian_renderer/__init__.py": {
        "render": "viewpoint_camera pc pipe bg_color scaling_modifier override_color",
    },
    "render.py": {"render_set": None, "render_sets": None},
    "scene/__init__.py": {
        "Scene.__init__": "self args gaussians load_iteration shuffle resolution_scales",
        "Scene.save": "self iteration",
        "Scene.getTrainCameras": "self scale",
        "Scene.getTestCameras": "self scale",
    },
    "scene/gaussian_model.py": {
        "GaussianModel.__init__": "self sh_degree",
        "GaussianModel.setup_functions": "self",
        "GaussianModel.capture": "self",
        "GaussianModel.restore": "self model_args training_args",
        "GaussianModel.create_from_pcd": "self pcd spatial_lr_scale",
        "GaussianModel.training_setup": "self training_args",
        "GaussianModel.update_learning_rate": "self iteration",
        "GaussianModel.construct_list_of_attributes": "self",
        "GaussianModel.save_ply": "self path",
        "GaussianModel.load_ply": "self path",
        "GaussianModel.reset_opacity": "self",
        "GaussianModel.replace_tensor_to_optimizer": "self tensor name",
        "GaussianModel._prune_optimizer": "self mask",
        "GaussianModel.prune_points": "self mask",
        "GaussianModel.cat_tensors_to_optimizer": "self tensors_dict",
        "GaussianModel.densification_postfix": "self new_xyz new_features_dc new_features_rest "
        "new_opacities new_scaling new_rotation",
        "GaussianModel.densify_and_clone": "self grads grad_threshold scene_extent",
        "GaussianModel.densify_and_split": "self grads grad_threshold scene_extent N",
        "GaussianModel.densify_and_prune": "self max_grad min_opacity extent max_screen_size",
        "GaussianModel.add_densification_stats": "self viewspace_point_tensor update_filter",
        "GaussianModel.oneupSHdegree": "self",
    },
    "arguments/__init__.py": {
        "ModelParams.extract": "self args",
        "get_combined_args": "parser",
    },
}

FLAGS = """iterations position_lr_init position_lr_final position_lr_max_steps feature_lr opacity_lr
scaling_lr rotation_lr percent_dense lambda_dssim densification_interval opacity_reset_interval
densify_from_iter densify_until_iter densify_grad_threshold random_background sh_degree
_source_path _model_path _images _resolution _white_background data_device eval
convert_SHs_python compute_cov3D_python debug"""


def functions(path):
    """Parameter names by qualified function name."""
    found = {}
    for node in ast.parse(path.read_text()).body:
        inner = node.body if isinstance(node, ast.ClassDef) else [node]
        prefix = f"{node.name}." if isinstance(node, ast.ClassDef) else ""
        for function in inner:
            if isinstance(function, ast.FunctionDef):
                found[prefix + function.name] = [a.arg for a in function.args.args]
    return found


@pytest.mark.parametrize("file", FUNCTIONS)
def test_functions_and_parameters(file):
    found = functions(ROOT / file)
    for name, parameters in FUNCTIONS[file].items():
        assert name in found, name
        if parameters is not None:
            assert found[name] == parameters.split(), name


def test_options_are_the_hosts():
    source = (ROOT / "arguments" / "__init__.py").read_text()
    assigned = {
        target.attr
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Attribute)
    }
    assert set(FLAGS.split()) <= assigned


def test_rasterizer_and_neighbours_are_imported_as_hosts_do():
    renderer = (ROOT / "gaussian_renderer" / "__init__.py").read_text()
    assert (
        "from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer"
    ) in renderer
    assert "from simple_knn._C import distCUDA2" in (
        (ROOT / "scene" / "gaussian_model.py").read_text()
    )


def test_it_is_a_checkout_not_a_package_of_ours():
    assert not (ROOT / "__init__.py").exists()
    for file in ROOT.rglob("*.py"):
        assert "fragprune" not in file.read_text(), file


def test_an_adapter_fits_the_host():
    from fragprune_plugins.hosts.choosing import choose
    from fragprune_plugins.hosts.source import HostRepo
    from fragprune_plugins.plugins.loading import load_plugins

    adapter = choose(HostRepo(ROOT), load_plugins().adapters, None)
    assert adapter.name == "vanilla-3dgs"
