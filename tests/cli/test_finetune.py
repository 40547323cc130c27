"""fragprune finetune, end to end on a tiny scene, with photographs and (--self) without."""

import json
import math
import shutil
import signal
from dataclasses import replace

import pytest
import torch
from cli.commands import run, run_error, run_json, succeeds
from finetune import tiny

import fragprune_plugins as fp
from fragprune_plugins import RasterInputs
from fragprune_plugins.adapting import InputError, read_ply
from fragprune_plugins.files import sidecar
from fragprune_plugins.learning.pressure import LEAST_PRESSURE, OWN_PRESSURE
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.finetune import loop
from fragprune_plugins.workbench.finetune.finished import advise, describe_untruncated
from fragprune_plugins.workbench.goals import parse_goal
from fragprune_plugins.workbench.models.formats.ply import write_ply
from fragprune_plugins.workbench.scenes import dataset


def test_writes_a_pair_and_a_table(data, path, model, tmp_path):
    before, out = path.read_bytes(), tmp_path / "results" / "out.ply"
    words = ("--data", data, "--out", out, "--train", "opacity")
    result = succeeds("finetune", path, *words, "--iters", 10, "--pressure", 1e-3)
    for said in ("PSNR, dB", "fragments per pixel", "original", "pruned", "x fewer fragments"):
        assert said in result.stdout
    share = f"A page to share: fragprune report {out.parent} --data {data}\n"
    assert f"fragprune view {out}. {share}" in result.stdout
    assert "fine-tuning" in result.stderr
    assert path.read_bytes() == before
    learned = read_ply(out)
    assert torch.equal(learned.xyz, model.xyz)
    assert not torch.equal(learned.opacity, model.opacity)
    assert learned.falloff is not None


def test_json_is_one_object_with_the_house_names(words):
    report = run_json(*words, 5, "--seed", 3)
    assert (report["iterations"], report["seed"], report["adapter"]) == (5, 3, None)
    assert (report["settings"]["train"], report["interrupted"]) == ("all", False)
    for part in ("before", "after"):
        assert report[part]["lpips"] is None
        assert report[part]["psnr"] > 10
    assert {"train_seconds", "engine", "device", "target_reached"} <= report.keys()
    assert report["pressure"] >= LEAST_PRESSURE


def test_says_what_the_model_is_without_its_thresholds(data, words, out):
    report = run_json(*words, 10, "--pressure", 1e-3)
    profile = run_json("profile", out)  # of the photographs in its record
    for key in ("psnr", "fragments_per_pixel"):
        assert report["untruncated"][key] == profile["columns"]["untruncated"][key]
        assert report["after"][key] == profile["columns"]["truncated"][key]
    text = run(*words, 10, "--pressure", 1e-3).stdout
    plain, psnr = report["untruncated"], report["untruncated"]["psnr"]
    quality = f"{psnr:.2f} dB PSNR ({psnr - report['before']['psnr']:+.2f})"
    drawn = f"{plain['fragments_per_pixel']:.1f} fragments per pixel"
    assert f"In viewers that know no cutoffs: {quality}, {drawn}" in text
    assert "out.ply, which holds the cutoffs." in text
    assert not sidecar.path_beside(out).exists()
    assert "know no cutoffs" not in run(*words, 10, "--control").stdout


@pytest.mark.parametrize(
    ("target", "before", "psnr", "advised"),
    [
        *(("photographs", 30.0, 29.6, False), ("photographs", 30.0, 29.4, True)),
        # the original's own PSNR is infinite: anything is far below, and may still not be seen
        *(("itself", math.inf, 48.3, False), ("itself", math.inf, 34.0, True)),
        ("itself", math.inf, math.inf, False),
    ],
)
def test_a_model_that_other_viewers_draw_badly_says_what_to_do(target, before, psnr, advised):
    plain = {"psnr": psnr, "target": target, "fragments_per_pixel": 9.0}
    line = describe_untruncated({"psnr": before}, plain | {"frame_ms": 1.0, "frame_ms_se": 0.1})
    assert ("--portable" in line) == advised
    assert ("equal pictures" in line) == (psnr == math.inf) != ("dB" in line)


@pytest.mark.parametrize(
    ("drop", "more", "advised"),
    [
        (0.04, {}, False),
        (0.06, {}, "--dropout 0.2 --keep 0.6 may"),
        (0.06, {"keep": 0.6}, "--dropout 0.2 may"),
        (0.06, {"settings": {"train": "all", "dropout": 0.2}}, "better: --keep 0.6 may"),
        (0.06, {"settings": {"train": "all", "dropout": 0.2}, "keep": 0.6}, False),
        (0.06, {"target": "itself"}, False),
        (0.06, {"pressure": None}, False),
        (0.06, {"settings": {"train": "opacity"}}, False),
    ],
)
def test_a_model_that_was_better_as_it_came_is_told_what_may_help(drop, more, advised):
    data = {"target": "photographs", "self": None, "keep": None, "shards": 1, "pressure": 1e-4}
    data |= {"before": {"psnr": 30.0}, "after": {"psnr": 30.0 - drop}}
    line = advise(data | {"settings": {"train": "all", "dropout": 0.0}} | more)
    assert (advised in line) if advised else line is None


@pytest.mark.parametrize(
    ("keep", "left", "why"),
    [(0.6, {36}, ""), ("visible", {*range(54)}, "which reached no pixel of any view.")],
)
def test_gaussians_are_removed_before_learning(path, model, words, out, keep, left, why):
    """Which, and that no picture changes where none was visible, is measure's to say."""
    model.xyz[:7, 1] += 50  # out of every picture
    write_ply(path, model)
    result = run(*words, 10, "--keep", keep, "--train", "opacity")
    learned = read_ply(out)
    rows = [(model.xyz == each).all(dim=1).nonzero().item() for each in learned.xyz]
    assert rows == sorted(rows)
    assert len(rows) in left
    for name in ("xyz", "f_dc", "f_rest", "scaling", "rotation"):
        assert torch.equal(getattr(learned, name), getattr(model, name)[rows])
    assert ("scoring Gaussians" in result.stderr) == (keep == 0.6)  # the bar
    assert f"Removed {60 - len(rows)} of 60 Gaussians before learning, {why}" in result.stdout
    report = run_json(*words, 10, "--keep", keep, "--train", "opacity")  # as it was reported
    assert report["keep"] == keep
    assert (report["before"]["gaussians"], report["after"]["gaussians"]) == (60, len(rows))


@pytest.mark.parametrize(
    ("keep", "options", "share"),
    [
        ("auto", (), 0.15),
        ("auto", ("--control",), 0.15),
        ("auto", ("--train", "opacity"), 0),
        ("auto", ("--dropout", 0.1), 0),
        (0.7, (), 0),
    ],
)
def test_gaussians_move_where_auto_says_which_can_be_spared(words, keep, options, share):
    report = run_json(*words, 10, "--keep", keep, *options)
    moved = int(share * report["after"]["gaussians"])
    assert report["relocated"] == moved
    told = run(*words, 10, "--keep", keep, *options, "--again").stdout
    assert (f"Moved {moved} of the others to where some were missing." in told) == (moved > 0)


def test_what_shows_beside_the_photographs_stays(data, model, words, out):
    shots = fp.load_dataset(data).train
    views = fp.views_near(shots)
    for keep, expected in (
        (0.7, fp.keep_best(model, 0.7, views)),
        ("auto", fp.keep_needed(model, shots, views)),
    ):
        report = run_json(*words, 3, "--keep", keep, "--train", "opacity")
        assert report["keep"] == keep
        assert torch.equal(read_ply(out).xyz, expected.xyz)
    alone = fp.keep_best(model, 0.7, [shot.view for shot in shots])
    assert not torch.equal(alone.xyz, fp.keep_best(model, 0.7, views).xyz)


def test_views_to_measure_on_take_no_room_of_those_to_learn_from(words, monkeypatch):
    kept, held = dataset.Pictures(dataset.ROOM), []

    def learn(left, photographs, *_, **__):
        held.append(len(set(kept) - {shot._pixels for shot in photographs.train}))
        raise InputError("learning", "begun", "", "")

    monkeypatch.setattr(dataset, "PICTURES", kept)
    monkeypatch.setattr("fragprune_plugins.workbench.finetune.api.finetune", learn)
    assert run(*words, 3).exit_code == 1
    assert held == [0]


def test_photographs_that_the_model_does_not_show_are_told_before_the_learning(path, model, words):
    """However much better a dark picture is than 12 dB."""
    assert "another scene" not in run(*words, 3).stderr
    moved = model.xyz + torch.tensor([1.0, 0.0, 0.0])
    for other in ({"f_dc": torch.full_like(model.f_dc, -99)}, {"xyz": moved}):
        write_ply(path, replace(model, **other))
        told = run(*words, 3).stderr
        assert "warning: MODEL shows its photographs at" in told
        assert all(option in told for option in ("--white-background", "--self"))


ALIKE = {"train": "all", "opacity_lr": None, "seed": 0, "views_per_step": 1}


def measured(
    goal, psnr=30.0, iterations=3, keep=None, adapter=None, words=(), pictures=None, **settings
):
    """A record's data of a training that began with so many dB."""
    begun = {"views": 2, "gaussians": 60, "psnr": psnr}
    figures = {"before": begun, "after": begun | {"goal": goal}, "iterations": iterations}
    figures |= {"keep": keep, "adapter": adapter, "host_options": [*words], "pictures": pictures}
    return figures | {"settings": ALIKE | {"goal": goal} | settings}


@pytest.mark.parametrize(
    ("control", "run", "quoted"),
    [
        ({}, {}, True),
        ({"keep": 0.5}, {"keep": 0.5}, True),
        ({}, {"keep": 0.5}, True),
        ({"keep": 0.5}, {}, False),
        *(({"dropout": share}, {"dropout": 0.2}, True) for share in (None, 0.0, 0.2)),
        *(({"dropout": 0.3}, {"dropout": share}, False) for share in (None, 0.2)),
        ({}, {"views_per_step": 2}, False),
        ({}, {"seed": 1}, False),
        ({}, {"iterations": 4}, False),
        ({}, {"adapter": "vanilla-3dgs"}, False),
        ({"adapter": "vanilla-3dgs"}, {}, False),
        ({"adapter": "vanilla-3dgs"}, {"adapter": "vanilla-3dgs"}, True),
        ({}, {"psnr": 30.1}, False),
        *(({"pictures": known}, {"pictures": "one"}, True) for known in (None, "one")),
        ({"pictures": "another"}, {"pictures": "one"}, False),
        ({"words": ["--lambda_dssim", "0.5"]}, {}, False),
        ({"words": ["--eval"]}, {"words": ["--eval"]}, True),
        ({"stop": 0.01}, {"stop": 0.01}, False),
        *(({}, {"stop": stop}, True) for stop in (None, "auto", 0.02)),
    ],
)
def test_a_control_is_quoted_only_of_one_training_without_a_stop(tmp_path, control, run, quoted):
    path = records.leave(tmp_path / "control.ply", "finetune", measured("control", **control))
    found = records.control_of(measured("pressure", **run), [tmp_path / "none", path])
    assert (found is not None) == quoted
    assert not quoted or found["goal"] == "control"


def test_a_control_truncates_nothing_and_is_quoted_by_the_same_training(words, tmp_path):
    """Also if it ran after: by the finished command."""
    assert "no control was found" in run(*words, 6).stdout
    control = run_json(*words, 6, "--control", "--out", tmp_path / "control.ply")
    assert control["speedup"] == pytest.approx(1, abs=0.05)
    assert control["untruncated"] is None
    assert read_ply(tmp_path / "control.ply").falloff is None
    finished = run(*words, 6).stdout
    assert "was finished before" in finished
    assert "no control was found" not in finished
    assert "pruning itself makes" in finished
    for more in ((), ("--again",)):
        assert run_json(*words, 6, *more)["control"] == control["after"]


def test_a_target_time_says_what_was_reached(words, monkeypatch):
    tiny.exact_clock(monkeypatch)
    report = run_json(*words, 20, "--target-time", 1.2)
    assert report["target_reached"]
    assert report["faster"] == pytest.approx(1.2, rel=0.02)
    assert report["settings"]["goal"] == "faster=1.2"


def test_a_bound_on_the_loss_trains_the_control_and_names_the_views(words, out):
    asked = (*words, 6, "--train", "opacity", "--max-drop", 5)
    report = run_json(*asked)
    found, lost = report["max_drop"], report["control"]["psnr"] - report["after"]["psnr"]
    assert (found["bound"], found["met"]) == (5, True)
    assert found["loss"] == pytest.approx(lost, abs=1e-3)
    assert found["loss"] <= 5
    goal = parse_goal(report["settings"]["goal"])
    assert goal.weight in (None, pytest.approx(found["pressure"]))
    assert read_ply(out).falloff is not None
    text = run(*asked).stdout
    assert "Loss against the control" in text
    for said in (text, run("report", out.parent).stdout):
        assert "chosen on these 2 views" in said


@pytest.mark.usefixtures("ctrl_c")
def test_an_interrupted_search_quotes_no_control_that_trained_for_longer(words, monkeypatch):
    tiny.at_loss(monkeypatch, 6 + 4, lambda: signal.raise_signal(signal.SIGINT))
    result = run(*words, 6, "--max-drop", 5, "--json")
    assert result.exit_code == 130
    report = json.loads(result.stdout)
    assert report["iterations"] < 6
    assert report["control"] is None
    assert report["untruncated"]["fragments_per_pixel"] > report["after"]["fragments_per_pixel"]


def test_sigterm_saves_at_once_and_leaves_with_143(words, out, monkeypatch):
    """It leaves no time to measure, and figures of a model do not outlive it."""
    before = signal.getsignal(signal.SIGTERM)
    run_json(*words, 5)
    assert records.beside(out) is not None
    tiny.at_loss(monkeypatch, 4, lambda: signal.raise_signal(signal.SIGTERM))
    measuring = "fragprune_plugins.workbench.figures.evaluate.measure_all"
    monkeypatch.setattr(measuring, None)  # whoever sends SIGTERM does not wait for this
    result = run(*words, 50, "--json")
    assert result.exit_code == 143
    report = json.loads(result.stdout)
    # The step under way is finished first.
    assert (report["interrupted"], report["iterations"], report["after"]) == (True, 4, None)
    assert read_ply(out).falloff is not None
    assert records.files(out.parent) == []
    assert signal.getsignal(signal.SIGTERM) is before


def test_divergence_is_a_stated_failure_and_writes_nothing(words, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "photometric_loss", lambda image, _: image.mean() * math.nan)
    error = run_error(*words, 5, "--json")
    assert error["code"] == "not-finite"
    assert error["where"].startswith("stage 2, step 1, view view0")
    assert "opacity" in error["found"]
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize("name", ["finetune", "render", "profile", "compare", "export"])
def test_help_teaches_by_example(name):
    said = succeeds(name, "--help").stdout
    assert f"fragprune {name} " in said
    assert "--json" in said


VIEWS = [(f"view{i}", camera.view()) for i, camera in enumerate(tiny.cameras(3))]


@pytest.fixture
def cameras(tmp_path):
    """The cameras.json that a host writes."""
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(tiny.host_cameras(tiny.cameras(17))))
    return path


def finetuned(path, out, *more):
    return run_json("finetune", path, "--self", "--out", out, "--iters", 40, *more)


def test_no_photograph_is_opened(data, path, out):
    for image in data.rglob("*.png"):
        image.unlink()
    report = finetuned(path, out, "--data", data, "--pressure", 1e-3, "--keep", 0.9)
    assert (report["before"]["gaussians"], report["after"]["gaussians"]) == (60, 54)
    assert report["target"] == report["after"]["target"] == "itself"
    assert report["after"]["views"] == 2  # the folder's held-out cameras
    assert report["before"]["psnr"] is None  # infinite
    assert 25 < report["after"]["psnr"] < 80
    assert report["after"]["fragments_per_pixel"] < report["before"]["fragments_per_pixel"]
    assert fp.load(out).falloff is not None


def test_without_options_the_cameras_are_those_of_its_training(path, cameras, out, tmp_path):
    model = tmp_path / "out/point_cloud/iteration_9/point_cloud.ply"
    model.parent.mkdir(parents=True)
    shutil.copy(path, model)
    shutil.copy(cameras, tmp_path / "out/cameras.json")
    words = "Namespace(source_path='gone', white_background=True)"
    (tmp_path / "out/cfg_args").write_text(words)
    named = ("--cameras", cameras, "--white-background")
    one, two = (
        finetuned(*words, "--iters", 2, "--again")["after"]
        for words in ((model, out), (path, out, *named))
    )
    assert one["views"] == two["views"] == 3
    assert [one[key] == two[key] for key in ("psnr", "fragments_per_pixel")] == [True, True]


def test_it_has_a_pressure_of_its_own(path, cameras, out):
    words = (path, out, "--cameras", cameras, "--iters", 2)
    report = finetuned(*words)
    assert report["settings"]["itself"] is True
    assert report["pressure"] == OWN_PRESSURE
    assert finetuned(*words, "--pressure", 3e-3)["pressure"] == 3e-3


@pytest.mark.parametrize("falloff", [None, 0.4])
def test_the_target_is_what_the_model_shows_as_it_came_in(model, falloff):
    """Truncated if it was: without its thresholds a pruned model is another picture."""
    store = falloff and fp.ThresholdStore.from_falloff(torch.full((len(model),), falloff))
    shot = fp.own_pictures(replace(model, thresholds=store), VIEWS, VIEWS).train[0]
    thresholds = store and store.values.detach().clone()
    if store:
        store.place(store.logits.detach() + 1)  # it learns
    with torch.no_grad():
        expected, other = (
            fp.rasterize(RasterInputs(shot.view, model.splats()), each).image
            for each in (thresholds, None if store else torch.full((len(model),), 0.4))
        )
    assert torch.equal(shot.image, expected)
    assert not torch.equal(shot.image, other)


def test_in_python_needs_no_cameras(model):
    dataset = fp.own_pictures(model)
    assert {shot.target for shot in (*dataset.train, *dataset.test)} == {"itself"}
    assert len(dataset.test) == 12
    image = dataset.test[0].image
    assert image.shape == (3, 800, 800)
    assert float(image.max()) > 0.1
    result = fp.finetune(model, fp.own_pictures(model, VIEWS), fp.Settings(2))
    # A stop and a pressure for photographs would change what they must not.
    assert (result.settings.itself, result.model.stop) == (True, None)
