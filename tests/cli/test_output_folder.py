"""A training's output folder in place of a model, and what is known of the training then."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from cli.commands import fails, run, run_json, succeeds
from finetune import tiny
from PIL import Image

import fragprune_plugins as fp
from fragprune_plugins import RasterInputs, load_dataset
from fragprune_plugins.errors import DatasetError, ModelFileError
from fragprune_plugins.hosts.photographs import Photographs, Resolution
from fragprune_plugins.workbench.commands.opening import as_trained, photographs_for
from fragprune_plugins.workbench.commands.options import SceneOptions
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.finetune import work
from fragprune_plugins.workbench.models.formats.ply import write_ply
from fragprune_plugins.workbench.scenes import generated
from fragprune_plugins.workbench.scenes.output import newest_model, trained_on


@pytest.fixture
def output(data, model, tmp_path):
    return tiny.host_output(tmp_path / "out", data, model)


@pytest.fixture
def lens(data):
    """Writes the cameras of the scene with another principal point."""
    file = data / "sparse" / "0" / "cameras.txt"
    return lambda centre: file.write_text(f"7 PINHOLE {tiny.SIDE} {tiny.SIDE} 36 36 {centre}\n")


@pytest.fixture
def short(tmp_path):
    """What a short fine-tuning of opacities is told."""
    return "--out", tmp_path / "r.ply", "--iters", 2, "--train", "opacity"


def test_commands_take_the_newest_model_and_the_trainings_cameras(output, tmp_path):
    result = succeeds("profile", output)
    assert "iteration_10000" in result.stderr
    assert f"Photographs: {tmp_path / 'data'}" in result.stderr
    assert run_json("profile", output)["views"] == 2
    assert run_json("compare", *sorted(output.glob("*/*/point_cloud.ply")))["psnr_change"] == 0
    pictures = run_json("render", output, "--out", tmp_path / "pictures")["files"]
    assert len(pictures) == 9
    with Image.open(pictures[0]) as picture:
        assert picture.size == (tiny.SIDE, tiny.SIDE)


@pytest.mark.parametrize(
    ("trained", "more", "side"),
    [(2, (), 16), (2, ("--resolution", 1), 32), (-1, (), 32), (20, (), 20)],
)
def test_pictures_are_drawn_at_the_size_that_the_training_had(
    data, model, tmp_path, trained, more, side
):
    """cameras.json has that of the photographs, whatever -r said."""
    output, pruned = tiny.host_output(tmp_path / "out", data, model, resolution=trained), "r.ply"
    run_json("finetune", output, "--self", "--iters", 1, "--out", tmp_path / pruned, *more)
    for model, own in ((output, ("--self", *more)), (tmp_path / pruned, ())):
        assert f", {side}x{side} pixels" in succeeds("compare", model, model, *own).stdout
    result = succeeds("render", output, "--out", tmp_path / "pictures", *more)
    for each in (tmp_path / "pictures").iterdir():
        with Image.open(each) as picture:
            assert picture.size == (side, side)
    assert ("--resolution 1" in result.stderr) == (side < tiny.SIDE)


def test_a_folder_with_one_output_folder_is_that(output, tmp_path):
    """As a demo's: the model lies in model/."""
    assert newest_model(tmp_path) == newest_model(output)
    assert newest_model(output).parent.name == "iteration_10000"
    (tmp_path / "second" / "point_cloud").mkdir(parents=True)
    with pytest.raises(ModelFileError, match="a folder without point_cloud"):
        newest_model(tmp_path)


def test_options_override_the_training(output, path):
    assert run_json("profile", output, "--resolution", 2)["views"] == 2
    fails("profile", output, "--images", "images_2", says="images_2", code=1)
    fails("profile", path, says="or cfg_args of a training")  # a model elsewhere needs --data


def test_pictures_are_drawn_as_the_training_did_around_the_middle(output, data, lens, tmp_path):
    """3DGS ignores the principal point, and so do its descendants."""
    psnr = {}
    for centre in ("20 16", "16 16"):
        lens(centre)
        psnr[centre] = run_json("profile", output)["psnr"]
        for more in (("--data", data), ("--out", tmp_path / "pictures")):
            assert run_json("profile", output, *more)["psnr"] == psnr[centre]
        assert run_json("compare", output, output, "--data", data)["a"]["psnr"] == psnr[centre]
    assert psnr["20 16"] == psnr["16 16"]
    for more in ((), ("--self",)):
        words = ("--out", pruned := tmp_path / f"pruned{len(more)}.ply", "--iters", 2)
        run_json("finetune", output, *words, *more)
        for centre in psnr:
            lens(centre)
            psnr[centre] = run_json("profile", pruned, "--data", data)["psnr"]
        assert run_json("profile", pruned)["psnr"] == psnr["16 16"]  # by the record beside it
        assert psnr["20 16"] == psnr["16 16"]
    again = run("finetune", pruned, "--out", tmp_path / "again.ply", "--iters", 1).stderr
    assert f"Photographs: {data}, which" in again


@pytest.mark.parametrize("middle", [True, False])
def test_a_model_is_fine_tuned_around_the_point_by_which_it_shows_its_photographs(
    data, model, path, lens, short, tmp_path, caplog, middle
):
    """Where it lies says what hosts usually do; the photographs know better."""
    lens("20 16")
    words = ("finetune", path, "--data", data)
    if not middle:
        scene = load_dataset(data, centred=False)
        for shot in (*scene.train, *scene.test):
            drawn = fp.rasterize(RasterInputs(shot.view, model.splats()))
            tiny.save_png(shot.path, drawn.image.detach())
        words = ("finetune", tiny.host_output(tmp_path / "out", data, model))
        caplog.clear()
    said = run(*words, *short).stderr
    where = "the middle" if middle else "the scene's principal point"
    assert f"MODEL is drawn around {where}" in said
    assert "principal point" not in caplog.text  # it was asked for, so nothing is wrong


@pytest.mark.parametrize("dropped", [True, False, None])
def test_alpha_counts_as_the_model_shows_it_where_nothing_tells(
    data, path, short, tmp_path, dropped
):
    """3DGS drops that of a COLMAP scene's images; some of its forks do not. None hides nothing."""
    for image in sorted((data / "images").iterdir()):
        with Image.open(image) as picture:
            faint = picture.convert("RGBA")
        alpha = Image.linear_gradient("L").resize(faint.size).point(lambda x: max(x, 128))
        if dropped is False:  # composited over black, the picture is what the model shows
            shown = np.asarray(faint, np.float32)[..., :3]
            whole = shown / (np.asarray(alpha, np.float32)[..., None] / 255)
            faint = Image.fromarray(whole.clip(0, 255).astype(np.uint8)).convert("RGBA")
        if dropped is not None:
            faint.putalpha(alpha)
        faint.save(image)
    psnr = run_json("profile", path, "--data", data)["psnr"]
    assert psnr > 25  # of faint colours at 8 bits
    assert run_json("compare", path, path, "--data", data)["a"]["psnr"] == psnr
    said = run("finetune", path, "--data", data, *short).stderr
    assert ("ignores the images' alpha" in said) == ("alpha" in said) == (dropped is True)
    assert "another scene" not in said
    pruned = run_json("profile", tmp_path / "r.ply", "--data", data)
    assert pruned["psnr"] == pytest.approx(psnr, abs=1)


def test_an_orbit_is_one_also_where_the_trainings_cameras_are_known(output, monkeypatch):
    monkeypatch.setitem(generated.around.__kwdefaults__, "pixels", 60)
    for words in (("profile", output), ("compare", output, output)):
        for option, views in (("--orbit", 12), ("--self", 2)):
            report = run_json(*words, option)
            assert report.get("b", report)["views"] == views


@pytest.mark.parametrize("white", [True, False])
def test_beside_data_the_training_says_whether_it_drew_over_white(data, model, tmp_path, white):
    known = tiny.host_output(tmp_path / "out", data, model, white_background=white)
    alone = tiny.host_output(tmp_path / "alone", data, model)
    asked = run_json("profile", known, "--data", data)
    told = ("--white-background",) if white else ()
    for figures in (asked, run_json("compare", known, known, "--data", data)["a"]):
        expected = run_json("profile", alone, "--data", data, *told)
        assert figures["psnr"] == expected["psnr"]
    (known / "cfg_args").write_text("not to be read")
    assert run_json("profile", known, "--data", data)["views"] == 2


@pytest.mark.parametrize("white", [True, False])
def test_pictures_have_the_background_of_the_training(data, model, tmp_path, white):
    """Also those of what was fine-tuned from its own pictures."""
    known = tiny.host_output(tmp_path / "out", data, model, white_background=white)
    pruned = tmp_path / "pruned.ply"
    run_json("finetune", known, "--self", "--resolution", 2, "--iters", 1, "--out", pruned)
    for each in (known, pruned):
        words = ("--cameras", known / "cameras.json", "--out")
        (file, *_) = run_json("render", each, *words, tmp_path / "pictures")["files"]
        with Image.open(file) as picture:
            assert picture.getpixel((0, 0)) == (255 * white,) * 3
        page = tmp_path / "page"
        run_json("view", each, *words, page)
        background = json.loads((page / "scene.json").read_text())["background"]
        assert background == [float(white)] * 3


@pytest.mark.parametrize("beside", [False, True])
def test_a_training_that_held_nothing_out_is_warned_of(data, model, tmp_path, caplog, beside):
    output = tiny.host_output(tmp_path / "out", data, model, eval=False)
    succeeds("profile", output, *(("--data", data, "--white-background") if beside else ()))
    assert "trained without --eval" in caplog.text


@pytest.mark.parametrize("held", [True, False])
def test_views_that_a_training_saw_are_not_said_to_be_held_out(data, model, tmp_path, held):
    output = tiny.host_output(tmp_path / "out", data, model, eval=held)
    out = tmp_path / "r/pruned.ply"
    words = ("--data", data, "--out", out, "--iters", 3, "--train", "opacity")
    said = "on 2 views that were held out." if held else "on 2 views that its training had seen."
    assert said in run("finetune", output, *words).stdout
    assert said in run_json("report", out.parent, "--data", data)["result"]
    page = (out.parent / "report.html").read_text()
    assert ("nothing learned from it" in page) is held
    assert run_json("finetune", output, *words)["seen"] is not held


@pytest.fixture
def listed(output):
    """Writes the cameras.json of a training that held these views out."""

    def write(held, at=0.0, of=9):
        rows = tiny.host_cameras(tiny.cameras())[:of]
        for row in rows:
            row["position"][0] += at
        first = [row for row in rows if row["id"] in held]
        twice = len(held) > len({*held})
        rows = first + [row for row in rows if twice or row["id"] not in held]
        (output / "cameras.json").write_text(json.dumps(rows))
        return output

    return write


@pytest.mark.parametrize(
    ("held", "of", "seen"),
    [
        *(((0, 8), 9, False), ((3, 4), 9, True), ((0,), 9, True)),
        ((0, 0, 8), 9, True),  # held out, and learned from
        ((0,), 4, True),  # a part of the photographs
    ],
)
def test_a_training_that_held_others_out_has_seen_ours(
    listed, short, monkeypatch, caplog, held, of, seen
):
    learned, told = work._learned, []

    def learning(*given):
        told.append("held out other views, of" in caplog.text)  # before it
        return learned(*given)

    monkeypatch.setattr(work, "_learned", learning)
    assert run_json("finetune", listed(held, of=of), *short)["seen"] is seen
    assert told == [seen]


@pytest.mark.parametrize(("at", "said"), [(0.0, False), (1e-5, False), (0.5, True)])
def test_a_training_whose_cameras_were_elsewhere_is_warned_of(listed, short, at, said):
    result = run("finetune", listed((0, 8), at), *short)
    assert ("the camera of view01.png was elsewhere" in result.stderr) is said


@pytest.mark.parametrize(("gain", "refused"), [(1.0, False), (1.2, True)])
def test_a_model_learns_no_photograph_it_shows_under_an_exposure(output, short, gain, refused):
    rows = (gain * torch.eye(3, 4)).tolist()
    (output / "exposure.json").write_text(json.dumps({"view00": rows}))
    if refused:
        fails("finetune", output, *short, says=("an exposure for view00", "--self"))
    else:
        succeeds("finetune", output, *short)


def test_figures_of_a_model_with_exposures_say_that_they_are_left_out(output):
    for learned, warned in ((1, False), (2, True)):
        rows = [[learned, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
        (output / "exposure.json").write_text(json.dumps({"view03": rows}))
        for words in (("profile", output), ("compare", output, output)):
            said = [each for each in run_json(*words)["warnings"] if "view03" in each]
            assert bool(said) == warned
    assert not run_json("profile", output, "--self")["warnings"]


def test_a_model_is_drawn_by_a_record_that_was_copied_before_it(
    output, data, tmp_path, monkeypatch
):
    """Copying without times makes it older: rsync -r and stores of objects go by the alphabet."""
    model = newest_model(output)
    monkeypatch.chdir(tmp_path)
    near = Path(os.path.relpath(model))
    said = records.Recorded(Photographs(data), (model,), drawing={"compensation": "antialiasing"})
    record = records.leave(model, "run", {"photographs": said.as_dict()})
    os.utime(record, (1, 1))
    assert as_trained(near)[1] == said.drawing
    assert records.beside(near)
    model.write_bytes(model.read_bytes() + b"\0")
    assert not records.beside(near)


@pytest.mark.parametrize("given", [True, False])
def test_the_model_before_is_read_in_the_world_that_the_run_noted(
    given, data, path, model, tmp_path
):
    """gsplat's trainer scales the world: with other cameras the model shows nothing."""
    before, after = (tmp_path / f"out/ply/point_cloud_{at}.ply" for at in (6, 9))
    before.parent.mkdir(parents=True)
    for each in (before, after):
        write_ply(each, model)
    world = ((0.5, 0.0, 0.0, 1.0), (0.0, 0.5, 0.0, 0.0), (0.0, 0.0, 0.5, 2.0), (0.0, 0.0, 0.0, 1.0))
    said = records.Recorded(Photographs(data, world=world), (before, after))
    records.leave(after, "run", {"photographs": said.as_dict()})
    scene = SceneOptions(data if given else None)
    for each in (before, after):
        assert photographs_for(each, scene).world == world
    assert photographs_for(path, SceneOptions(data)).world is None


def test_a_training_without_a_record_is_compared_as_the_other_one_was_drawn(
    output, data, tmp_path, caplog
):
    """A host's arguments do not tell. Others are drawn as stored, or as their own run says."""
    other = newest_model(shutil.copytree(output, tmp_path / "other"))
    said = records.Recorded(Photographs(data), (other,), drawing={"compensation": "antialiasing"})
    records.leave(other, "run", {"photographs": said.as_dict()})
    mine = shutil.copy(newest_model(output), tmp_path / "mine.ply")
    begun = newest_model(shutil.copytree(output, tmp_path / "begun"))
    later = shutil.copy(begun, tmp_path / "begun" / "later.ply")
    known = records.Recorded(Photographs(data), (begun, later), filtered=True)
    records.leave(later, "run", {"photographs": known.as_dict()})
    changes = [run_json("compare", each, other)["psnr_change"] for each in (output, mine, begun)]
    assert changes[0] == 0 != changes[1] == changes[2]
    (warned,) = [each.message for each in caplog.records if "no record" in each.message]
    assert f"{newest_model(output)} has no record" in warned
    (tmp_path / "gsplat/ply").mkdir(parents=True)
    plain = shutil.copy(mine, tmp_path / "gsplat/ply/point_cloud_29999.ply")
    assert run_json("compare", plain, other)["psnr_change"] == 0


def test_a_record_that_says_nothing_of_its_result_is_believed_by_its_time_alone(tmp_path):
    """Of a folder, or written before records did: neither is read to find that out."""
    (tmp_path / "out").mkdir()
    record = records.leave(tmp_path / "out", "profile", {})
    assert records.beside(tmp_path / "out")
    os.utime(record, (1, 1))
    assert not records.beside(tmp_path / "out")


def test_photographs_that_are_learned_from_too_are_not_said_to_be_held_out(model, tmp_path):
    data = tiny.write_blender(tmp_path / "scene", tiny.photographs(model))
    (data / "transforms_test.json").write_text((data / "transforms_train.json").read_text())
    write_ply(path := tmp_path / "a model.ply", model)
    words = ("--data", data, "--out", tmp_path / "a b.ply", "--iters", 3, "--train", "opacity")
    said = run("finetune", path, *words).stdout
    assert "on 7 views that its training had seen." in said
    assert f"fragprune view '{tmp_path / 'a b.ply'}'. A page" in said  # as words of a command


@pytest.mark.parametrize(
    ("asked", "size"),
    [
        (-1, Resolution(width=1600, shrink_only=True)),
        *((1, Resolution(divide=1)), (4, Resolution(divide=4)), (500, Resolution(width=500))),
    ],
)
def test_the_size_of_photographs_is_the_hosts(data, model, tmp_path, asked, size):
    known = {"resolution": asked, "white_background": True, "images": "images_8"}
    read = trained_on(newest_model(tiny.host_output(tmp_path / "out", data, model, **known)))
    assert read == Photographs(data, size, True, "images_8", centred=True, opaque=True)


def test_a_training_without_an_argument_for_their_size_reads_photographs_as_they_are(output):
    known = output / "cfg_args"
    known.write_text(f"Namespace(sh_degree=1, source_path={str(output)!r})")
    assert trained_on(newest_model(output)).resolution == Resolution()


@pytest.mark.parametrize(("known", "opaque"), [({}, False), ({"train_test_exp": False}, True)])
def test_3dgs_since_october_2024_drops_the_alpha_of_blenders_images(model, tmp_path, known, opaque):
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "transforms_train.json").touch()
    output = tiny.host_output(tmp_path / "out", tmp_path / "scene", model, **known)
    assert trained_on(newest_model(output)).opaque == opaque


@pytest.mark.parametrize(
    "text",
    [
        *("", "Namespace(", "Namespace(images='a')", "Namespace(source_path=print(1))"),
        *("Namespace(source_path='a', resolution='x')", "[1]", "(" * 5000, "\x00"),
        "Namespace(source_path='a', images=" + '{"a":' * 500,
    ],
)
def test_arguments_that_are_none_are_refused_and_not_executed(output, text, capsys):
    (output / "cfg_args").write_text(text)
    with pytest.raises(DatasetError, match="cfg_args: not the arguments of a training") as stated:
        trained_on(newest_model(output))
    assert capsys.readouterr().out == ""
    assert "memory" not in stated.value.found
