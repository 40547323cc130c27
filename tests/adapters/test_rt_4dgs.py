"""RT-4DGS: its call, its rows, its YAML and its checkpoints, on a miniature of the host."""

import itertools
import sys

import pytest
import torch
from cli.commands import succeeds
from miniatures.rt_4dgs import PythonHost, RigidHost, RT4DGSHost
from miniatures.runs import edit, miniature, written
from scenes import blended

from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.errors import AlignmentError, HostNeedsError, UsageError
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.plugins.hookspecs import hookimpl
from fragprune_plugins.slicing import cutting
from fragprune_plugins.slicing.cutting import slice_at
from fragprune_plugins.testing.host import joint
from fragprune_plugins.testing.invariants.case import FixedThresholds
from fragprune_rt_4dgs import RT4DGS, neighbours
from fragprune_rt_4dgs.config import YAMLFile
from fragprune_rt_4dgs.dialect import RT4DGSDialect

COUNT = 16
ENGINE = ReferenceEngine()
HOSTS = {"4D rotation": RT4DGSHost, "without": RigidHost, "in Python": PythonHost}


mini, options_of = miniature(RT4DGSHost, RT4DGS)


def of(mini, driver=None, **options):
    return options_of(mini, driver=driver or RT4DGSHost(), engine="reference", **options)


def spread_out(model):
    """Gaussians of all shapes and speeds, some of them not there at the camera's moment."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for group in model.optimizer.param_groups:
            value, name = group["params"][0], group["name"]
            if name in ("rotation", "rotation_r", "f_rest"):
                value.copy_(torch.randn(value.shape, generator=generator))
            elif name == "t":
                value.copy_(1.5 * torch.randn(value.shape, generator=generator))
    return model


@pytest.mark.parametrize("driver", HOSTS.values(), ids=HOSTS)
def test_the_six_outputs_against_their_definitions(mini, driver):
    """Depth, alpha and flow drawn as colours by the oracle, in double precision."""
    notes = FixedThresholds()
    with joint(plugins=[notes], **of(mini, driver())) as host:
        model, camera = spread_out(host.model(COUNT)), host.camera()
        host.store(model).open(host.adapter.opacities(model))
        with torch.no_grad():
            package = host.render(camera, model)
        view, splats = notes.inputs.view, notes.inputs.splats
        flow = splats.features[:, 1:]
        depth = (
            splats.means @ camera.world_view_transform[:3, 2] + camera.world_view_transform[3, 2]
        )
        assert not flow.any()
        for name, values in {"depth": depth, "alpha": torch.ones(len(depth))}.items():
            expected = blended(view, splats, values)
            torch.testing.assert_close(package[name], expected, rtol=1e-4, atol=1e-4)
        assert tuple(package["flow"].shape) == (2, view.height, view.width)
        there = (model.get_marginal_t(camera.timestamp) > 0.05)[:, 0]
        assert 0 < int(there.sum()) < COUNT
        assert not package["radii"][~there].any()
        assert package["radii"][there].any()


@pytest.mark.parametrize("driver", HOSTS.values(), ids=HOSTS)
def test_flow_is_blended_as_colour_is(mini, driver, monkeypatch):
    with joint(**of(mini, driver())) as host:
        model, camera = spread_out(host.model(COUNT)), host.camera()
        host.store(model).open(host.adapter.opacities(model))
        seen = {}
        unpack = RT4DGSDialect.unpack

        def moving(self, call):
            seen["flow"] = call.arguments["flow_2d"] = torch.rand_like(call.arguments["flow_2d"])
            seen["inputs"] = unpack(self, call)
            return seen["inputs"]

        monkeypatch.setattr(RT4DGSDialect, "unpack", moving)
        with torch.no_grad():
            package = host.render(camera, model)
        assert torch.equal(seen["inputs"].splats.features[:, 1:], seen["flow"])
        assert package["flow"].any()


@pytest.mark.parametrize("opened", [True, False])
def test_moments_are_cut_by_the_engine_that_draws(mini, opened, monkeypatch):
    cut = []

    class Plugin:
        @hookimpl
        def fragprune_create_engine(self, name, device):
            return ENGINE

    def noting(splats, moment, engine):
        cut.append((len(splats), engine))
        return slice_at(splats, moment, engine=engine)

    monkeypatch.setattr(cutting, "slice_at", noting)
    with joint(plugins=[Plugin()], **of(mini)) as host:
        model, camera = host.model(COUNT), host.camera()
        if opened:
            host.store(model).open(host.adapter.opacities(model))
        host.render(camera, model)
    assert cut == [(COUNT, ENGINE)]


@pytest.mark.parametrize("driver", [RT4DGSHost, RigidHost], ids=["4D rotation", "without"])
def test_every_parameter_gets_a_gradient_even_if_nobody_is_there(mini, driver):
    with joint(**of(mini, driver())) as host:
        model, camera = host.model(COUNT), host.camera()
        camera.timestamp = 1e3
        package = host.render(camera, model)
        package["render"].sum().backward()
        assert not package["radii"].any()
        for group in model.optimizer.param_groups:
            assert not group["params"][0].grad.any(), group["name"]
        assert not package["viewspace_points"].grad.any()


@pytest.mark.parametrize("state", ["today", "2024"])
def test_slicing_in_python_draws_the_same_with_the_same_thresholds(mini, tmp_path, state):
    """Two ways of the host to one picture: rows picked by us, or by nobody."""
    pictures = []
    if state == "2024":  # its 4D rotations had their axes in another order
        mini = written(RT4DGSHost, tmp_path)
        edit(mini / "scene/gaussian_model.py", ".flip(1, 2)", "")
    for driver in (RT4DGSHost(), PythonHost()):
        notes = FixedThresholds(torch.linspace(0.02, 0.6, COUNT))
        with joint(plugins=[notes], **of(mini, driver)) as host:
            model = spread_out(host.model(COUNT))
            model.active_sh_degree = 0  # the host's Python draws directions to the moved means
            with torch.no_grad():
                host.store(model).logits.copy_(torch.logit(notes.values))
                pictures.append(host.render(host.camera(), model)["render"])
    assert len(notes.inputs.splats) < COUNT
    torch.testing.assert_close(*pictures, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kernel", ["a, -b, -c, -d, b, a, -d, c, c, d, a, -b, d, -c, b, a", "a"])
@pytest.mark.parametrize("state", ["today", "2024"])
def test_a_kernel_that_turns_otherwise_than_its_python_is_refused(tmp_path, state, kernel):
    root = written(RT4DGSHost, tmp_path)
    if state == "2024":
        edit(root / "scene/gaussian_model.py", ".flip(1, 2)", "")
    package = root / "submodules/a/diff_gaussian_rasterization"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package.parent / "forward.cu").write_text(f"glm::mat4({kernel});")
    codes = {each.code for each in RT4DGS().match(HostRepo(root)).findings}
    assert ("rotations" in codes) == ((kernel == "a") == (state == "2024"))


def test_rows_that_are_not_those_of_the_moment_are_refused_with_both_counts(mini, monkeypatch):
    with joint(**of(mini, PythonHost())) as host:
        model, camera = spread_out(host.model(COUNT)), host.camera()
        host.step(model, camera, 1)
        marginal, calls = type(model).get_marginal_t, itertools.count()
        there, other = (int((model.get_marginal_t(now) > 0.05).sum()) for now in (0.1, 1.5))
        assert there != other

        def fickle(self, timestamp, scaling_modifier=1):
            return marginal(self, timestamp if next(calls) else 1.5, scaling_modifier)

        monkeypatch.setattr(type(model), "get_marginal_t", fickle)
        with pytest.raises(AlignmentError, match="compute_cov3D_python") as caught:
            host.render(camera, model)
        assert caught.value.found == f"{other} Gaussians"
        assert f"the {there} of {COUNT}" in caught.value.expected


YAML = """
gaussian_dim: {dim}
rot_4d: {rot}
batch_size: 2
time_duration: [0.0, 1.0]
ModelParams:
  source_path: "{data}"
  model_path: "{out}"
  resolution: 1
  sh_degree: 1
  eval: True
PipelineParams:
  env_map_res: {sky}
  eval_shfs_4d: False
OptimizationParams:
  iterations: {iterations}
  densify_from_iter: 2
  densification_interval: 4
  densify_until_iter: 9
  densify_grad_threshold: 0.0005
  sh_increase_interval: 4
  lambda_opa_mask: 1e-2
"""
OPTIONS = {"device": "cpu", "settings": Settings(iterations=5, threshold_lr=0.3, train="opacity")}


def command(mini, config, *more):
    return [str(mini / "train.py"), "--config", str(config), *map(str, more)]


@pytest.fixture
def config(photographs, tmp_path):
    def write(name="a.yaml", **values):
        defaults = {"dim": 4, "rot": True, "sky": 0, "iterations": 10}
        text = YAML.format(**(defaults | {"data": photographs, "out": tmp_path / "out"} | values))
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def load(path):
    return torch.load(path, weights_only=False)


FROZEN = {"xyz": 1, "dc": 2, "rest": 3, "scaling": 4, "rotation": 5, "t": 13, "scaling_t": 14}


@pytest.mark.parametrize("rot", [True, False], ids=["4D rotation", "without"])
def test_train_then_finetune_moves_no_frozen_bit_and_counts_every_step(mini, config, tmp_path, rot):
    file = config(rot=rot)
    text = file.read_text()
    summary = run(command(mini, file), RunOptions(**OPTIONS))
    assert (summary.adapter, summary.steps) == ("rt-4dgs", 5)
    assert summary.model_before == tmp_path / "out" / "chkpnt10.pth"
    assert summary.model_after == tmp_path / "out" / "chkpnt17.pth"
    (before, first), (after, last) = map(load, (summary.model_before, summary.model_after))
    assert (first, last, len(before), len(after)) == (10, 17, 19, 19)
    differing = [name for name, i in FROZEN.items() if not torch.equal(before[i], after[i])]
    assert differing == []
    assert rot is False or torch.equal(before[15], after[15])
    assert not torch.equal(before[6], after[6])
    assert "fragprune" not in before[11]
    thresholds = after[11]["fragprune"]
    assert len(thresholds["logits"]) == len(after[1]) == summary.gaussians
    assert thresholds["steps"] == 5
    assert summary.fragments_after < summary.fragments_before
    assert summary.photographs is None
    assert "no PLY" in summary.not_compared.found
    assert file.read_text() == text


def test_thresholds_in_a_checkpoint_are_not_missed_beside_it(mini, config):
    words = ("--device", "cpu", "--engine", "reference", "--iters", 5)
    assert "chkpnt17.pth" in succeeds("run", *words, "--", *command(mini, config())).stdout


def test_a_checkpoint_with_thresholds_is_applied_and_learned_on(mini, config, tmp_path):
    first = run(command(mini, config()), RunOptions(**OPTIONS))
    more = ("--start_checkpoint", first.model_after)
    again = run(command(mini, config(), *more), RunOptions(**OPTIONS))
    assert again.model_before == first.model_after
    capture, iteration = load(again.model_after)
    assert iteration == 17 + 5 + 2  # one is left out, and in one there is no step
    assert capture[11]["fragprune"]["steps"] == 10
    assert again.fragments_before == pytest.approx(first.fragments_before, rel=0.3)


def test_the_sky_comes_back_and_stands_still(mini, config, tmp_path):
    """The loop makes a new environment map after it has restored the old one."""
    summary = run(command(mini, config(sky=1)), RunOptions(**OPTIONS))
    before, after = (load(path)[0] for path in (summary.model_before, summary.model_after))
    assert before[17].any()
    assert torch.equal(before[17].detach(), after[17].detach())
    wide = Settings(iterations=5, threshold_lr=0.3, train="all")
    (tmp_path / "out" / "chkpnt17.pth").unlink()
    options = RunOptions(**{**OPTIONS, "settings": wide}, stage="finetune")
    moved = load(run(command(mini, config(sky=1)), options).model_after)[0]
    assert not torch.equal(before[17].detach(), moved[17].detach())
    assert not torch.equal(before[13], moved[13])


def test_what_the_host_cannot_resume_is_refused_before_it_trains(mini, config, tmp_path):
    file = config(dim=3, rot=False)
    with pytest.raises(UsageError, match="gaussian_dim") as caught:
        run(command(mini, file), RunOptions(**OPTIONS))
    assert "--from-iter" in caught.value.remedy
    assert not (tmp_path / "out").exists()
    options = RunOptions(**OPTIONS, stage="finetune", from_iter=8)
    summary = run(command(mini, config(dim=3, rot=False, iterations=12)), options)
    assert len(load(summary.model_after)[0]) == 12
    assert summary.fragments_after <= summary.fragments_before


def test_ctrl_c_leaves_a_checkpoint(mini, tmp_path):
    with joint(**of(mini, output=tmp_path)) as host:
        model, camera = host.model(COUNT), host.camera()
        for iteration in (2, 3):
            host.step(model, camera, iteration)
        capture, iteration = load(host.save_learned())
        assert iteration == 2
        assert torch.equal(capture[11]["fragprune"]["logits"], host.store(model).logits)


def test_the_last_section_of_the_file_wins(tmp_path):
    file, yaml = tmp_path / "a.yaml", YAMLFile("--config")
    file.write_text("batch_size: 2\nA:\n  rate: 1e-5\n  iterations: 30_000\n  eval: True")
    assert yaml.read(file) == {"batch_size": 2, "rate": 1e-5, "iterations": 30000, "eval": True}
    values = {"iterations": 7, "save_iterations": [3, 7], "start_checkpoint": "a b/c'd.pth"}
    file.write_text(yaml.copied(file, values))
    assert yaml.read(file) == {"batch_size": 2, "rate": 1e-5, "eval": True} | values


@pytest.mark.parametrize("text", [None, "- 1\n- 2\n", "a: [1\n", "a: ${b}\n", "{gaussian_dim: 4}"])
def test_a_file_that_cannot_be_read_or_added_to_is_refused(mini, tmp_path, text):
    file = tmp_path / "a.yaml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(UsageError, match="--config"):
        run(command(mini, file), RunOptions(**OPTIONS))


def test_without_omegaconf_the_error_says_who_needs_it(mini, config, monkeypatch):
    monkeypatch.setitem(sys.modules, "omegaconf", None)
    with pytest.raises(HostNeedsError, match=r"omegaconf.*host reads.*pip install omegaconf"):
        run(command(mini, config()), RunOptions(**OPTIONS))


def test_neighbours_are_the_nearest_of_their_batch():
    points = torch.rand(30, 3, generator=torch.Generator().manual_seed(0))
    ends = torch.tensor([12, 30], dtype=torch.int32)
    rows, squares = torch.zeros(30, 4, dtype=torch.int32), torch.zeros(30, 4)
    neighbours.knnquery(30, 4, points, points, ends, ends, rows, squares)
    for query in range(30):
        own = slice(0, 12) if query < 12 else slice(12, 30)
        away = (points[own] - points[query]).square().sum(dim=1)
        nearest = away.sort()
        assert rows[query].tolist() == (nearest.indices[:4] + own.start).tolist()
        torch.testing.assert_close(squares[query], nearest.values[:4], rtol=1e-5, atol=1e-7)


def test_a_ply_is_no_model_of_this_host(tmp_path):
    with pytest.raises(UsageError, match="a PLY, from which RT-4DGS cannot resume"):
        RT4DGS().checkpoint_from_ply(tmp_path / "a.ply", 3, tmp_path / "b.pth")
