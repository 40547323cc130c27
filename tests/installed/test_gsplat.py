"""The real gsplat on the CPU, where only our kernels answer."""

import contextlib
import gzip
import inspect
import io
import json
import math
import runpy
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from click.testing import CliRunner
from installed.gsplat_host import axes, new_params, releases
from installed.gsplat_host import draw as drawn_by_gsplat

from fragprune_gsplat import Gsplat
from fragprune_gsplat.projection import Rules, covariances, project
from fragprune_plugins.adapting import HostRepo, read_ply
from fragprune_plugins.errors import InputError, SessionError, SidecarError, UsageError
from fragprune_plugins.files import sidecar
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.learning.goals import Fewer
from fragprune_plugins.learning.schedule import JointSchedule, Settings
from fragprune_plugins.testing.fresh import fresh
from fragprune_plugins.workbench.commands import cli

WIDTH, HEIGHT = 48, 32
LOOP = Path(__file__).parents[2] / "docs" / "how-to" / "gsplat_loop.py"
RELEASES = releases()


@pytest.fixture(params=RELEASES.values(), ids=RELEASES.keys())
def folder(request):
    """The folder of each gsplat that is here."""
    return request.param


@pytest.fixture
def session_on(session_on, folder):
    return partial(session_on, path=folder)


def cameras(count: int = 1):
    viewmats = torch.eye(4).repeat(count, 1, 1)
    viewmats[:, 0, 3] = torch.arange(count) * 0.3
    viewmats[:, 2, 3] = 4.0
    K = torch.tensor([[40.0, 0, 23], [0, 42.0, 17], [0, 0, 1]])
    return viewmats, K.repeat(count, 1, 1)


def attached(count: int = 40, seed: int = 0):
    """(params, optimizers) that a session knows, because a strategy has looked at them."""
    from gsplat import DefaultStrategy

    params, optimizers = new_params(count, seed=seed)
    DefaultStrategy().check_sanity(params, optimizers)
    return params, optimizers


def pruned(session):
    """Such parameters, and thresholds that were learned for them."""
    params, _ = attached()
    session.store(params).logits = torch.randn(40).requires_grad_(True)
    return params


def watched(session, tell):
    """Let a session ``tell(inputs, outputs)`` whatever it draws; how it drew before."""
    engine = session.engine(torch.device("cpu"))
    rasterize = engine.rasterize

    def telling(inputs, thresholds):
        outputs = rasterize(inputs, thresholds)
        tell(inputs, outputs)
        return outputs

    engine.rasterize = telling
    return rasterize


def draw(params, count: int = 1, **options):
    viewmats, Ks = cameras(count)
    return drawn_by_gsplat(
        params, **{"viewmats": viewmats, "Ks": Ks, "width": WIDTH, "height": HEIGHT, **options}
    )


def brute(params, K, viewmat, *, antialiased: bool = False):
    """Picture, alpha and depth by gsplat's own pure-torch projection and a loop over Gaussians.

    gsplat ships these formulas beside its kernels; the blending loop is written from its contract.
    """
    from gsplat.cuda import _torch_impl as theirs

    with torch.no_grad():
        shape = getattr(theirs, "_quat_scale_to_covar_preci", None)
        if shape is None:  # 1.6
            from gsplat.cuda._math import _quat_scale_to_covar_preci as shape
        covars, _ = shape(params["quats"], params["scales"].exp())
        given = (params["means"], covars, viewmat[None], K[None], WIDTH, HEIGHT)
        radii, means2d, depths, conics, factor = theirs._fully_fused_projection(
            *given, calc_compensations=antialiased
        )
        campos = torch.linalg.inv(viewmat)[:3, 3]
        shs = torch.cat([params["sh0"], params["shN"]], dim=1)
        directions = torch.nn.functional.normalize(params["means"] - campos, dim=-1)
        colors = (theirs._spherical_harmonics(1, directions, shs) + 0.5).clamp_min(0)
        opacities = params["opacities"].sigmoid() * (factor[0] if antialiased else 1.0)
        radii = radii[0].reshape(len(opacities), -1).expand(-1, 2)
        pixels = torch.arange(HEIGHT), torch.arange(WIDTH)
        y, x = torch.meshgrid(*(each + 0.5 for each in pixels), indexing="ij")
        light = torch.ones(HEIGHT, WIDTH)
        picture, depth = torch.zeros(HEIGHT, WIDTH, 3), torch.zeros(HEIGHT, WIDTH)
        for i in depths[0].argsort().tolist():
            if depths[0, i] < 0.01:
                continue
            dx, dy = x - means2d[0, i, 0], y - means2d[0, i, 1]
            a, b, c = conics[0, i]
            alpha = opacities[i] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
            alpha = torch.where(alpha < 1 / 255, 0.0, alpha.clamp_max(0.999))
            for at, axis in ((x, 0), (y, 1)):  # tiles of 16 pixels, whole ones
                first, last = ((means2d[0, i, axis] + s * radii[i, axis]) / 16 for s in (-1, 1))
                alpha = alpha * (at >= first.floor() * 16) * (at < last.ceil() * 16)
            picture += (light * alpha)[..., None] * colors[i]
            depth += light * alpha * depths[0, i]
            light = light * (1 - alpha)
        assert light.min() > 1e-3  # the loop above need not know where pixels end
        return picture, 1 - light, depth


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("packed", [True, False])
def test_our_picture_is_the_one_of_gsplats_own_formulas(session_on, packed, mode):
    with session_on(Gsplat()):
        params, _ = new_params(40)
        params["opacities"].data -= 1.5  # so faint that no pixel ends early
        viewmats, Ks = cameras(2)
        how = {"packed": packed, "render_mode": "RGB+ED", "rasterize_mode": mode}
        with torch.no_grad():
            colors, alphas, info = draw(params, 2, **how)
        assert colors.shape == (2, HEIGHT, WIDTH, 4)
        assert alphas.shape == (2, HEIGHT, WIDTH, 1)
        for k in range(2):
            picture, alpha, depth = brute(params, Ks[k], viewmats[k], antialiased=mode != "classic")
            torch.testing.assert_close(colors[k, ..., :3], picture, rtol=0, atol=2e-5)
            torch.testing.assert_close(alphas[k, ..., 0], alpha, rtol=0, atol=2e-5)
            seen = alpha > 0.01  # a quotient of small numbers says little
            expected = depth[seen] / alpha[seen]
            torch.testing.assert_close(colors[k][seen][:, 3], expected, rtol=1e-3, atol=1e-3)
        rows = info["gaussian_ids"] if packed else torch.arange(40).repeat(2)
        assert info["radii"].shape == ((len(rows),) if packed else (2, 40)) + axes()


def test_a_loop_in_half_precision_gets_the_picture_of_gsplats_kernels(session_on):
    """They project in float32 whatever a user's autocast says, and so do we."""
    with session_on(Gsplat()):
        params, _ = new_params(40)
        expected, *_ = draw(params)
        with torch.autocast("cpu", torch.bfloat16):
            found, *_ = draw(params)
        assert torch.equal(found, expected)


class OnAGpu(torch.Tensor):
    """Says that it is, and is in no matrix product."""

    is_cuda = True

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        assert func.__name__ not in {"__matmul__", "matmul", "mm", "bmm", "einsum"}
        return super().__torch_function__(func, types, args, kwargs)


def test_nothing_that_decides_a_place_is_left_to_tf32():
    """Torch may round the factors of matrices on a GPU to 10 bits, if a user lets it."""
    generator = torch.Generator().manual_seed(0)
    made = [torch.randn(*shape, generator=generator) for shape in ((9, 3), (9, 4), (9, 3), (9,))]
    viewmats, Ks = cameras()
    bounds = {"eps2d": 0.3, "near": 0.01, "far": 1e10, "radius_clip": 0, "floor": 0.005}
    rules = Rules(**bounds, antialiased=True, tight=True)

    def projected(means, quats, scales, opacities):
        covars = covariances(quats, scales.exp())
        given = viewmats[0].as_subclass(type(means)), Ks[0].as_subclass(type(means))
        return project(means, covars, opacities.sigmoid(), *given, WIDTH, HEIGHT, rules)

    expected = projected(*made)
    found = projected(*(each.as_subclass(OnAGpu) for each in made))
    for name, each in vars(expected).items():
        plain = getattr(found, name).as_subclass(torch.Tensor)
        torch.testing.assert_close(plain, each, rtol=1e-4, atol=1e-4)


def test_radii_are_those_of_gsplats_own_formulas(session_on):
    """To the pixel until 1.4. Since 1.5 gsplat's formulas in torch leave opacity out."""
    with session_on(Gsplat()):
        from gsplat.cuda import _torch_impl as theirs

        params, _ = new_params(40)
        params["opacities"].data.fill_(9.0)  # sqrt(2 log 255) is 3.329, gsplat's bound 3.33
        viewmats, Ks = cameras(2)
        covars = covariances(params["quats"], params["scales"].exp())
        expected = theirs._fully_fused_projection(
            params["means"], covars, viewmats, Ks, WIDTH, HEIGHT
        )[0]
        ours = draw(params, 2, packed=False)[2]["radii"]
        assert ours.shape == expected.shape
        assert (ours > 0).any()
        assert set((expected - ours).unique().tolist()) <= ({0, 1} if axes() else {0})


@pytest.mark.parametrize(
    ("mode", "channels"), [("RGB", 3), ("D", 1), ("ED", 1), ("RGB+D", 4), ("RGB+ED", 4)]
)
def test_every_render_mode_gives_its_channels(session_on, mode, channels):
    with session_on(Gsplat()):
        params, _ = new_params(40)
        backgrounds = torch.ones(1, 3)
        colors, alphas, _ = draw(params, render_mode=mode, backgrounds=backgrounds)
        assert colors.shape == (1, HEIGHT, WIDTH, channels)
        if mode.startswith("RGB"):
            plain = draw(params)[0]
            over = plain + (1 - alphas)
            torch.testing.assert_close(colors[..., :3], over, rtol=0, atol=1e-6)


def test_strategies_find_the_gradients_on_the_screen_packed_or_not(session_on):
    with session_on(Gsplat()):
        params, _ = new_params(40)
        weights, grads = torch.rand(1, HEIGHT, WIDTH, 3), {}
        for packed in (True, False):
            colors, _, info = draw(params, packed=packed)
            info["means2d"].retain_grad()
            (colors * weights).sum().backward()
            grads[packed] = info["means2d"].grad
            if packed:
                rows = info["gaussian_ids"]
        assert 0 < len(rows) <= 40
        assert grads[True].abs().sum() > 0
        torch.testing.assert_close(grads[True], grads[False][0, rows], rtol=1e-5, atol=1e-6)
        for name, parameter in params.items():
            assert torch.isfinite(parameter.grad).all(), name


UNDRAWN = {"camera_model": "fisheye", "with_ut": True, "tile_size": 8, "absgrad": True}
UNDRAWN |= {"sh_degree": 4, "distributed": True}


@pytest.mark.parametrize("name", UNDRAWN)
def test_what_we_do_not_draw_is_refused_by_name(session_on, name):
    with session_on(Gsplat()):
        from gsplat import rasterization

        params, _ = new_params(40)
        known = name in inspect.signature(rasterization).parameters
        with pytest.raises(InputError if known else TypeError, match=name):  # 1.4 knows fewer
            draw(params, **{name: UNDRAWN[name]})


def test_surfels_are_refused_where_nothing_of_them_would_learn(session_on):
    """They are drawn by a function of their own, so no step would be counted."""
    with session_on(Gsplat()):
        from gsplat import rasterization_2dgs

        params, _ = attached()
        given = (params["means"], params["quats"], params["scales"].exp(), params["opacities"])
        with pytest.raises(InputError, match="surfels"):
            rasterization_2dgs(*given, params["sh0"], *cameras(), WIDTH, HEIGHT)


def test_absolute_gradients_are_refused_until_nothing_reads_them(session_on):
    """A strategy reads them where it adds Gaussians, which it does no more in stage 2."""
    with session_on(Gsplat(), settings=Settings(iterations=4), from_step=1):
        from gsplat import DefaultStrategy

        params, optimizers = new_params(40)
        strategy = DefaultStrategy(absgrad=True)
        strategy.check_sanity(params, optimizers)
        strategy_state = strategy.initialize_state()
        with pytest.raises(InputError, match="absgrad"):
            draw(params, absgrad=True)
        draw(params)[0].mean().backward()
        for step in range(2):
            colors, _, info = draw(params, absgrad=True)
            strategy.step_pre_backward(params, optimizers, strategy_state, step, info)
            colors.mean().backward()
            strategy.step_post_backward(params, optimizers, strategy_state, step, info)
            optimizers["opacities"].step()
        assert torch.isfinite(params["opacities"]).all()


def test_a_plain_dict_is_refused_and_there_is_no_command_to_run():
    with pytest.raises(SessionError, match="ParameterDict"):
        Gsplat().model_of(SimpleNamespace(instance=None, arguments={"params": {}}))
    with pytest.raises(UsageError, match="activate"):
        run(["-m", "gsplat.rendering"], RunOptions(device="cpu"))
    assert Gsplat().match(HostRepo.installed("gsplat")).fits
    assert not Gsplat().match(HostRepo.installed("numpy")).fits


def test_the_commit_is_the_version_in_the_folder(folder):
    name, _, version = HostRepo(folder, "gsplat").commit.partition(" ")
    metadata = list(folder.glob("gsplat-*.dist-info"))
    assert (name, version) == (("gsplat", metadata[0].name[7:-10]) if metadata else ("", ""))


def test_check_takes_the_name_of_an_installed_host():
    done = CliRunner().invoke(cli, ["check", "--json", "gsplat"])
    report = json.loads(done.stdout)
    assert (done.exit_code, report["fits"]) == (0, "gsplat")
    seams = next(a for a in report["adapters"] if a["adapter"] == "gsplat")["seams"]
    assert {state["status"] for state in seams} == {"found", "at import"}
    unknown = CliRunner().invoke(cli, ["check", "--json", "no_host_of_this_name"])
    assert unknown.exit_code == 1


@pytest.mark.parametrize("count", [1, 3])
def test_a_target_is_met_over_every_camera_of_a_call(session_on, count):
    """The cameras see ever less, so that no one of them could speak for all."""
    settings = Settings(iterations=8, threshold_lr=0.3, goal=Fewer(1.5), train="opacity")
    with session_on(Gsplat(), settings=settings) as session:
        params, optimizers = attached()
        viewmats, Ks = cameras(count)
        viewmats[:, 2, 3] *= torch.arange(count) * 4 + 1

        def picture():
            return draw(params, viewmats=viewmats, Ks=Ks)[0]

        counts = []
        for _ in range(8):
            picture().mean().backward()
            optimizers["opacities"].step()
            params["opacities"].grad = None

        def tell(inputs, drawn):
            pair = rasterize(replace(inputs, stop=None), None), drawn
            counts.append(torch.stack([each.fragments_per_pixel for each in pair]))

        rasterize = watched(session, tell)
        with torch.no_grad():
            picture()
        assert len(counts) == count
        before, after = torch.stack(counts).sum(dim=0).tolist()
        summary = session.finish()
    assert before / after == pytest.approx(1.5, rel=0.03)  # 0.01, and opacities moved since
    assert summary.target_reached
    assert summary.fragments_before / summary.fragments_after == pytest.approx(1.5, rel=0.01)


def test_every_camera_of_a_call_is_drawn_with_the_models_stop_and_rim(session_on):
    settings = Settings(iterations=4, stop=0.3, rim="soft")
    with session_on(Gsplat(), settings=settings) as session:
        (params, _), drawn = attached(), []
        watched(session, lambda inputs, _: drawn.append((inputs.stop, inputs.rim)))
        for _ in range(2):
            drawn.clear()
            draw(params, 3)[0].mean().backward()
    assert drawn == [(0.3, "soft")] * 3


@pytest.mark.parametrize("learns", [False, True])
def test_a_view_is_the_same_in_any_batch_and_while_its_pose_learns(session_on, learns):
    """What a target draws again are the Gaussians of now: none are kept for each view."""
    with session_on(Gsplat(), settings=Settings(iterations=9, goal=Fewer(1.5))) as session:
        params, optimizers = attached()
        poses, _ = cameras(4)
        for step, pair in enumerate([[0, 1], [2, 3], [3, 1], [0, 2], [1, 2], [3, 0]]):
            viewmats = poses[pair] + (1e-4 * step if learns else 0)
            known = params["opacities"].detach().sigmoid()
            draw(params, 2, viewmats=viewmats.requires_grad_(learns))[0].mean().backward()
            optimizers["opacities"].step()
            for parameter in params.values():
                parameter.grad = None
        state, drawn = session.last_state, []
        watched(session, lambda inputs, _: drawn.append(inputs.splats.opacities))
        with torch.no_grad():
            for again in state.views.values():
                again()
    assert len(state.seen) == 4
    assert len(drawn) == 8
    assert all(torch.equal(each, known) for each in drawn)


def test_a_target_is_met_without_views_drawn_before_rows_changed(session_on):
    """Their calls hold tensors of rows that are no more."""
    settings = Settings(iterations=8, goal=Fewer(1.5), train="opacity")
    schedule = JointSchedule(settings, 1)
    with session_on(Gsplat(), settings=settings, schedule=schedule, freeze=False) as session:
        from gsplat.strategy.ops import remove

        params, optimizers = attached()
        for step in range(8):
            draw(params, 2 if step < 3 else 1)[0].mean().backward()
            for parameter in params.values():
                parameter.grad = None
            if step == 3:
                remove(params, optimizers, {}, torch.arange(40) < 5)
        summary = session.finish()
    assert summary.gaussians == 35
    assert session.last_state.stage._held


def test_thresholds_go_through_a_file_beside_ones_own_checkpoint(session_on, tmp_path):
    with session_on(Gsplat()) as session:
        params, file = pruned(session), tmp_path / "splats.pt"
        torch.save(params.state_dict(), file)
        session.save(params, file)
        again, _ = new_params(40, seed=1)
        again.load_state_dict(torch.load(file))
        with pytest.raises(SessionError, match="without thresholds"):
            session.save(again, file)
        session.load(again, file)
        assert torch.equal(session.store(again).logits, session.store(params).logits)
        few, _ = new_params(7)
        with pytest.raises(SidecarError, match="thresholds of 40"):
            session.load(few, file)


def test_thresholds_of_a_file_wait_while_another_model_is_drawn(session_on, tmp_path):
    """They are not forgotten: to draw the file's Gaussians without them stays an error."""
    file = tmp_path / "splats.pt"
    with session_on(Gsplat()) as session:
        params = pruned(session)
        torch.save(params.state_dict(), file)
    with session_on(Gsplat()) as session, torch.no_grad():
        known, _ = attached(seed=1)
        assert session.store(known) is not None
        saved = torch.load(file)
        draw(known)
        with pytest.raises(SessionError, match="no seam attached"):
            draw(saved)


def copied(params):
    return {name: value.detach().clone() for name, value in params.items()}


SAVED = {
    "state": lambda params: params.state_dict(),
    "copies": copied,
    "nested": lambda params: {"step": 3, "splats": params.state_dict()},
    "copies by another name": lambda params: {"step": 3, "params": copied(params)},
}


@pytest.mark.parametrize("form", SAVED)
@pytest.mark.parametrize(("learn", "opened"), [(True, False), (False, False), (False, True)])
def test_torch_saves_and_loads_parameters_with_thresholds(
    session_on, tmp_path, form, learn, opened
):
    file, logits = tmp_path / "splats.pt", torch.randn(40)

    def at(mode):
        return file.open(mode) if opened else contextlib.nullcontext(file)

    def loaded():
        with at("rb") as source:
            saved = torch.load(source)
        return saved if "means" in saved else next(reversed(saved.values()))

    with session_on(Gsplat()) as session:
        params, _ = attached()
        session.store(params).logits = logits.clone().requires_grad_(True)
        with at("wb") as target:
            torch.save(SAVED[form](params), target)
        with torch.no_grad():
            picture = draw(params)[0]
    with session_on(Gsplat(), learn=learn) as session:
        from gsplat import DefaultStrategy

        again, optimizers = new_params(7, seed=1)
        saved = loaded()
        with pytest.raises(SessionError, match="no seam attached"), torch.no_grad():
            draw(saved)
        DefaultStrategy().check_sanity(again, optimizers)
        for name, value in saved.items():
            again[name].data = value
        with torch.no_grad():
            assert torch.equal(draw(again)[0], picture)
        assert torch.equal(session.store(again).logits, logits)
        del saved["quats"]
        torch.save(saved, io.BytesIO())  # neither a file nor all parameters


def test_what_can_have_no_sidecar_is_saved_loudly(session_on, tmp_path, caplog):
    with session_on(Gsplat()) as session:
        params, _ = attached()
        torch.save(params.state_dict(), io.BytesIO())
        assert not caplog.messages
        session.store(params).logits = torch.randn(40).requires_grad_(True)
        with gzip.open(tmp_path / "splats.pt.gz", "wb") as file:
            torch.save(params.state_dict(), file)
    (said,) = caplog.messages
    assert said == "torch:save: without cutoffs: pass the path of a file"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("name", ["means", "opacities"])
def test_copies_of_other_gaussians_are_saved_loudly(session_on, tmp_path, caplog, name):
    """Which thresholds were theirs is not known: those of the model have learned since."""
    with session_on(Gsplat()) as session:
        params = pruned(session)
        best = copied(params)
        params[name].data += 0.1
        torch.save(best, tmp_path / "best.pt")
    (said,) = caplog.messages
    assert said.startswith("torch:save: without cutoffs: no learning model has these")
    assert not sidecar.find(tmp_path / "best.pt")


def test_a_file_that_was_read_for_something_else_changes_nothing(session_on, tmp_path):
    with session_on(Gsplat()) as session:
        params = pruned(session)
        torch.save(params.state_dict(), tmp_path / "other.pt")
        with torch.no_grad():
            params["means"] += 1
            kept = session.store(params).logits.clone()
            torch.load(tmp_path / "other.pt")
            session.store(params).logits += 1
            draw(params)
        assert torch.equal(session.store(params).logits, kept + 1)


@pytest.mark.parametrize("count", [1, 2, 51])
def test_relocation_is_equation_nine_also_for_the_most_copies(session_on, count):
    """Until 1.5 as printed; 1.6 keeps the new opacity from 0.005 to 1 first."""
    with session_on(Gsplat()):
        from gsplat import MCMCStrategy
        from gsplat.relocation import compute_relocation

        binoms = MCMCStrategy().initialize_state()["binoms"]
        old, scales = torch.tensor([0.1, 0.6]), torch.full((2, 3), 0.5)
        opacities, new = compute_relocation(old, scales, torch.full((2,), count), binoms)
        bounded = "min_opacity" in inspect.signature(compute_relocation).parameters
        for row, o in enumerate(old.double().tolist()):
            expected = 1 - (1 - o) ** (1 / count)
            expected = max(expected, 0.005) if bounded else expected
            total = sum(
                math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * expected ** (k + 1)
                for i in range(1, count + 1)
                for k in range(i)
            )
            assert opacities[row].item() == pytest.approx(expected, rel=1e-5)
            assert new[row].tolist() == pytest.approx([0.5 * o / total] * 3, rel=1e-4)


def documented(folder: str, words: list[str]) -> str:
    """What the loop prints, with the gsplat of this folder."""
    sys.path.insert(0, folder)
    sys.argv, said = words, io.StringIO()
    with contextlib.redirect_stdout(said):
        runpy.run_path(words[0], run_name="__main__")
    return said.getvalue()


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_the_documented_loop_runs_and_exports_thresholds(folder, photographs, tmp_path, strategy):
    def loop(*words: object) -> None:
        words = (LOOP, photographs, *words, "--strategy", strategy)
        said = fresh(documented, str(folder), [str(w) for w in words])
        assert ("fragments per pixel" in said) != ("--control" in words)
        assert "None" not in said

    loop(tmp_path, "--steps", 6, "--stage2", 6)
    before, after = (read_ply(tmp_path / f"{name}.ply") for name in ("trained", "finetuned"))
    names = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")
    moved = [n for n in names if not torch.equal(getattr(before, n), getattr(after, n))]
    assert moved == list(names)
    store, info = sidecar.load(tmp_path / "finetuned.ply")
    assert (len(store), info.adapter) == (len(after.xyz), "gsplat")
    assert not sidecar.path_beside(tmp_path / "trained.ply").exists()
    if strategy == "default":  # a trained model needs none
        loop(tmp_path / "again", "--start", tmp_path / "trained.ply", "--stage2", 3)
        again = sidecar.load(tmp_path / "again" / "finetuned.ply")[0]
        assert (len(again), again.steps) == (len(before.xyz), 3)
        loop(tmp_path / "again", "--start", tmp_path / "trained.ply", "--stage2", 3, "--control")
