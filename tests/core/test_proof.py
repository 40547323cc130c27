"""A host's own rasterizer is compared with our engine before anything is trained."""

import contextlib
import json
import shutil
from dataclasses import replace
from importlib import import_module

import pytest
import torch
from cli import commands
from cli.commands import run_json
from miniatures import compiled, vanilla_3dgs
from miniatures.compiled import DIFFERENCES

from fragprune_graphdeco import likeness, proof
from fragprune_graphdeco.proof import RasterizerProver
from fragprune_plugins import Pressure, Settings
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.errors import EngineError, ProofError
from fragprune_plugins.hosts.dialect import Proof
from fragprune_plugins.injection import proofs, rasterizing
from fragprune_plugins.testing.invariants.case import FixedThresholds, open_all
from fragprune_vanilla_3dgs import Vanilla3DGS
from reference_renderer.covariance import rotation_matrices

RENDERER = "gaussian_renderer/__init__.py"
EQUAL = {
    "none": ("the picture", "radii"),
    "depth": ("the picture", "radii", "depth"),
    "depth without gradient": ("the picture", "radii", "depth, without gradient"),
    "depth over alpha": ("the picture", "radii", "depth over alpha"),
    "inverse depth": ("the picture", "radii", "inverse depth"),
    "alpha": ("the picture", "radii", "alpha"),
    "median depth": ("the picture", "radii", "median depth, without gradient"),
    "largest weight": ("the picture", "radii", "depth of the largest weight, without gradient"),
    "normals": ("the picture", "radii", "normals, without gradient"),
    "normals in view space": ("the picture", "radii", "normals in view space, without gradient"),
    "normals, y up": ("the picture", "radii", "normals in view space, y up, without gradient"),
}
OTHERWISE = {
    "projection": "another picture: in the host's own call",
    "dilation": "another picture",
    "exponent": "another picture",
    "alpha's cap": "another picture: in a chart",
    "faint fragments": "another picture",
    "stop": "another picture",
    "near plane": "another picture: in a chart",
    "colours below 0": "another picture: in a chart",
    "absolute gradient": "gradient of means2D, column 2 differs",
    "gradient by pixels": "gradient of means2D, column 0, 1 differs",
    "frozen positions": "gradient of means3D is zero",
    "regularised scales": "gradient of scales differs",
    "straight-through opacities": "gradient of opacities differs",
    "unknown": "output 3 (more), which the host uses, is unknown",
    "constant": "output 3 (more), which the host uses, is unknown",
    "half the radii": "output 2 (radii), which the host uses, is unknown",
}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("FRAGPRUNE_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def host(tmp_path):
    """Makes the demo's host with a rasterizer of its own that has a difference built in."""

    def make(difference, returned="more", result='"more": more'):
        folder = tmp_path / "host"
        shutil.copytree(vanilla_3dgs.HOST, folder, dirs_exist_ok=True)
        compiled.write(folder, difference)
        if DIFFERENCES[difference].also or DIFFERENCES[difference].weighed:
            source = (folder / RENDERER).read_text()
            source = source.replace("image, radii =", f"image, radii, {returned} =")
            source = source.replace('"radii": radii,', f'"radii": radii, {result}')
            (folder / RENDERER).write_text(source)
        return folder

    return make


def running(folder, **options):
    options = {"learn": False, "prove": True} | options
    return vanilla_3dgs.running(path=folder, drop_in=None, **options)


@pytest.fixture
def made(monkeypatch):
    """Notes every proof that is made."""
    made, prove = [], RasterizerProver.prove
    monkeypatch.setattr(RasterizerProver, "prove", lambda *each: made.append(1) or prove(*each))
    return made


def draw(folder, *, turned=False, **options):
    """Draw one view under a session; its proofs."""
    with running(folder, **options) as host:
        camera = host.camera(96, 64)
        if turned:  # around the points, which are around the origin
            turn = torch.eye(4)
            turn[:3, :3] = rotation_matrices(torch.tensor([[0.9, 0.3, -0.2, 0.1]]))[0]
            for name in ("world_view_transform", "full_proj_transform"):
                setattr(camera, name, turn @ getattr(camera, name))
            camera.camera_center = camera.camera_center @ turn[:3, :3].T
        host.render(camera, host.model(40, setup=False))
        return list(host.session.proofs.values())


@pytest.mark.parametrize("difference", EQUAL)
def test_outputs_are_told_by_their_numbers(host, difference):
    (proved,) = draw(host(difference), turned=True)
    assert proved.outputs == EQUAL[difference]
    assert f"render ({RENDERER}:" in proved.call


@pytest.mark.parametrize("made_inside", [False, True])
def test_a_host_that_draws_in_inference_mode_is_proved_as_any_other(host, made_inside):
    with running(host("none")) as started, contextlib.ExitStack() as inference:
        if made_inside:
            inference.enter_context(torch.inference_mode())
        model, camera = started.model(40, setup=False), started.camera(96, 64)
        with torch.inference_mode():
            started.render(camera, model)
        (proved,) = started.session.proofs.values()
    assert proved.outputs == EQUAL["none"]


def black(model):
    """Where colours are cut: the harmonics give 0 but for rounding, on either side of the cut."""
    model._features_dc.copy_(torch.tensor(-0.5) / 0.28209479177387814)
    model._features_rest.zero_()


def long_and_thin(model):
    """Of the determinant a c - b b float32 leaves few digits. A model has some such Gaussians."""
    model._scaling[:4] = torch.tensor([9.0, 1e-4, 1e-4]).log()
    model._rotation[:4] = torch.tensor([0.92, 0.0, 0.0, 0.38])  # 45 degrees on the picture
    model._opacity[:4] = -3.9


@pytest.mark.parametrize(("made", "count"), [(black, 40), (long_and_thin, 300)])
def test_gaussians_that_a_host_rounds_otherwise_do_not_hinder_a_proof(host, made, count):
    with running(host("none")) as started:
        model = started.model(count, setup=False)
        with torch.no_grad():
            made(model)
        started.render(started.camera(96, 64), model)
        (proved,) = started.session.proofs.values()
    assert proved.outputs == EQUAL["none"]


@pytest.mark.parametrize("difference", OTHERWISE)
def test_a_rasterizer_that_draws_otherwise_is_refused(host, difference):
    with pytest.raises(ProofError) as refused:
        draw(host(difference), learn=True, freeze=False)
    assert OTHERWISE[difference] in refused.value.found
    assert "fragprune finetune" in refused.value.remedy


@pytest.mark.parametrize("difference", ["absolute gradient", "gradient by pixels"])
def test_gradients_on_the_screen_matter_only_where_ours_densifies(host, difference):
    (proved,) = draw(host(difference))
    assert proved.outputs[0].startswith("the picture, with another gradient on the screen")


def test_every_difference_is_tried():
    assert {*EQUAL, *OTHERWISE, "scale modifier", "no background"} == DIFFERENCES.keys()


def test_an_unknown_output_that_nobody_reads_is_let_be(host):
    (proved,) = draw(host("unknown", "_more", ""))
    assert proved.outputs[2] == "something unknown that is not read"


def test_normals_are_unknown_where_the_camera_stands_as_the_world_does(host):
    with pytest.raises(ProofError, match="output 3"):
        draw(host("normals"))


def with_thresholds(folder):
    """What a host is given beside a picture with fixed thresholds, and a way to draw the same view
    with other features.
    """
    fixed = FixedThresholds(torch.linspace(0.02, 0.4, 40))
    options = {"path": folder, "drop_in": None, "plugins": [fixed]}
    with vanilla_3dgs.joint(Settings(iterations=9, goal=Pressure(0.0)), **options) as running:
        model, camera = running.model(40), running.camera(96, 64)
        open_all(running, model)
        found = running.render(camera, model)["more"]

    def again(features):
        splats = replace(fixed.inputs.splats, features=features)
        inputs = replace(fixed.inputs, splats=splats, means2d_hook=None)
        return ReferenceEngine().rasterize(inputs, fixed.values)

    return found, again, fixed.inputs


def test_median_depth_is_made_with_thresholds(host):
    found, again, inputs = with_thresholds(host("median depth"))
    weights = torch.cat([again(each).features for each in torch.eye(40).split(8, dim=1)])
    expected = compiled.median_depth(weights, inputs.splats, inputs.view)
    off = (found[0] - expected).abs() > 1e-3
    assert off.sum() <= off.numel() // 200
    assert expected.gt(0).any()


@pytest.mark.parametrize("difference", ["depth", "depth without gradient", "depth over alpha"])
def test_an_output_that_was_found_is_made_with_thresholds(host, difference):
    found, again, inputs = with_thresholds(host(difference))
    view = inputs.view.viewmatrix
    expected = DIFFERENCES[difference].also[0](
        again(inputs.splats.means @ view[:3, 2:3] + view[3, 2])
    )
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)
    assert found.requires_grad == expected.requires_grad


def scaled(session, model):
    draw = import_module("gaussian_renderer").render
    draw(session.camera(96, 64), model, session.driver.pipe(), torch.zeros(3), 1.5)


def test_a_setting_with_another_value_is_proved_again(host, caplog):
    folder = host("scale modifier")
    with running(folder, learn=True) as session:
        model, camera = session.model(40), session.camera(96, 64)
        session.render(camera, model)
        session.render(session.camera(64, 48, side=0.1), model, torch.ones(3))
        model.active_sh_degree = 0
        session.render(camera, model)
        assert len(session.session.proofs) == 2  # views and bands need no other than black and lit
        with pytest.raises(ProofError, match="another picture"):
            scaled(session, model)
    with running(folder) as session:  # the host's own stage: stage 2 would refuse it
        model = session.model(40, setup=False)
        session.render(session.camera(96, 64), model)
        scaled(session, model)
    assert "another picture" in caplog.text


def test_a_background_that_lights_is_proved_by_itself(host):
    with running(host("no background"), learn=True) as session:
        model, camera = session.model(40), session.camera(96, 64)
        session.render(camera, model)
        with pytest.raises(ProofError, match="another picture"):
            session.render(camera, model, torch.ones(3))


def antialiased(folder):
    source = (folder / RENDERER).read_text()
    (folder / RENDERER).write_text(source.replace("pipe.debug,", "pipe.debug, antialiasing=True,"))
    return folder


def test_antialiasing_is_differentiated_otherwise_by_vanilla(host):
    (proved,) = draw(antialiased(host("none")))
    assert proved.outputs == EQUAL["none"]


@pytest.mark.parametrize("difference", ["dilation", "frozen positions", "regularised scales"])
def test_antialiasing_excuses_nothing_else(host, difference):
    with pytest.raises(ProofError):
        draw(antialiased(host(difference)))


def adapted(**members):
    """Vanilla's adapter, with a dialect that has other members."""
    dialect = type("Dialect", (Vanilla3DGS.dialect_type,), members)
    return type("Adapter", (Vanilla3DGS,), {"dialect_type": dialect})()


@pytest.mark.parametrize(
    ("by", "known"),
    [({"trust": True}, ""), ({"adapter": adapted(otherwise="it widens more")}, "it widens more")],
    ids=["whoever trusts it", "its adapter"],
)
def test_a_host_that_draws_otherwise_may_go_on_if_someone_says_so(host, caplog, by, known):
    assert draw(host("dilation"), learn=True, **by) == [None]
    assert "another picture" in caplog.text
    assert ("as known: it widens more" in caplog.text) == bool(known)


def test_a_call_that_no_engine_of_ours_draws_is_left_to_the_host(host):
    def unpack(self, call):
        raise EngineError("a score", "one that ours lack", "none", "Draw it yourself.")

    assert draw(host("none"), adapter=adapted(unpack=unpack)) == [None]


def test_a_proof_is_kept_until_the_rasterizer_or_what_proves_it_changes(host, made, monkeypatch):
    folder = host("none")
    first, second = draw(folder), draw(folder)
    assert first == second
    assert len(made) == 1
    told = run_json("check", folder)
    assert told["proved"] == [str(first[0])]
    assert "proved" in told["sentence"]
    file = folder / compiled.PACKAGE / "__init__.py"
    file.write_text(file.read_text() + "# another build\n")
    assert run_json("check", folder)["proved"] == []
    draw(folder)
    assert len(made) == 2
    monkeypatch.setattr(proof, "_OWN", "mended")
    draw(folder)
    assert len(made) == 3


def test_a_proof_that_cannot_be_written_is_not_kept(tmp_path):
    (tmp_path / "proof.json" / "in the way").mkdir(parents=True)
    proofs.keep(Proof("a call", ("the picture",)), tmp_path / "proof.json")
    assert proofs.read(tmp_path / "proof.json") is None


def test_a_failed_proof_is_kept_and_not_repeated(host, made):
    folder, said = host("dilation"), set()
    for _ in range(2):
        with pytest.raises(ProofError) as refused:
            draw(folder, learn=True)
        said.add(str(refused.value))
    assert len(said) == len(made) == 1
    checked = commands.run("check", folder, "--json")
    told = json.loads(checked.stdout)
    assert (checked.exit_code, told["proved"]) == (1, [])
    assert "another picture" in told["failed"][0]
    assert "draws otherwise" in told["sentence"]


def test_a_proof_that_found_no_memory_counts_as_none(host, monkeypatch):
    """A host may live on: 3DGS does when it draws for its viewer. The next call proves again."""
    prove = RasterizerProver.prove

    def without_memory(*_):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB. GPU 0 has")

    folder = host("dilation")
    monkeypatch.setattr(RasterizerProver, "prove", without_memory)
    assert draw(folder, learn=True, trust=True) == [None]
    with running(folder, learn=True) as session:
        model, camera = session.model(40), session.camera(96, 64)
        with pytest.raises(ProofError, match=r"no room on the GPU .*2 GiB\).*--trust"):
            session.render(camera, model)
        monkeypatch.setattr(RasterizerProver, "prove", prove)
        with pytest.raises(ProofError, match="another picture"):
            session.render(camera, model)


def test_a_proof_that_fails_by_itself_counts_as_none_either(host, monkeypatch):
    made = []
    monkeypatch.setattr(RasterizerProver, "prove", lambda *_: made.append(1) or 1 / 0)
    with running(host("none"), learn=True) as session:
        model, camera = session.model(40), session.camera(96, 64)
        for _ in range(2):
            with pytest.raises(ZeroDivisionError):
                session.render(camera, model)
    assert len(made) == 2


def test_a_host_may_have_torch_make_tensors_elsewhere(host, monkeypatch):
    """On a GPU by default, where numbers from a generator on the CPU are refused."""
    chart, gradient = likeness.chart, proof._gradient
    made = []

    def there(function):
        def called(*given):
            made.append(torch.empty(0).device.type)
            return function(*given)

        return called

    monkeypatch.setattr(likeness, "chart", there(chart))
    monkeypatch.setattr(proof, "_gradient", there(gradient))
    prove = RasterizerProver.prove

    def by_a_host(*given):
        with torch.device("meta"):
            return prove(*given)

    monkeypatch.setattr(RasterizerProver, "prove", by_a_host)
    with contextlib.suppress(NotImplementedError, RuntimeError):  # our engine draws for the host
        draw(host("none"))
    assert set(made) == {"cpu"}


def test_a_session_that_never_draws_by_ours_proves_nothing(host):
    assert draw(host("projection"), prove=False) == []


def test_the_proof_leaves_no_trace_in_a_training(host, monkeypatch):
    folder, after = host("none"), []
    for way in (rasterizing.proved, lambda *_, **__: None):
        monkeypatch.setattr(rasterizing, "proved", way)
        torch.manual_seed(3)
        with running(folder, learn=True) as session:
            model = session.model(40)
            session.step(model, session.camera(96, 64), 1)
            after.append({**vanilla_3dgs.tensors(model), "random": torch.get_rng_state()})
    for name, value in after[0].items():
        assert torch.equal(value, after[1][name]), name
