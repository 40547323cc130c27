"""fragprune run where no adapter fits: the host trains alone, then its plain PLY learns."""

import json
import os
import shutil
import signal

import pytest
from cli.commands import fails, run, run_json, succeeds
from core.test_verdict import fork as fork  # a fixture
from finetune import tiny
from miniatures.runs import TINY, edit
from miniatures.vanilla_3dgs import HOST

from fragprune_plugins.adapting import Photographs, Resolution, read_ply
from fragprune_plugins.files.atomic import locked
from fragprune_plugins.workbench.commands import cli
from fragprune_plugins.workbench.figures.records import beside, recorded

TRAINING = """
import os, shutil, sys

scene, out = sys.argv[2], sys.argv[4]


def save(scene):
    scene.save(30000)


os.makedirs(out + "/point_cloud/iteration_9")
shutil.copy({model!r}, out + "/point_cloud/iteration_9/point_cloud.ply")
with open(out + "/cfg_args", "w") as arguments:
    arguments.write(f"Namespace(eval=True, images='images', model_path={{out!r}}, resolution=1, "
                    f"sh_degree=1, source_path={{scene!r}}, white_background=False)")
print("trained as it is")
sys.exit({code})


def training(image, photograph):
    loss = ssim({shown}image["render"], photograph.original_image)
    loss.backward()
"""
WAITING = """import os, time

print(os.getpid(), flush=True)
time.sleep(60)
import os"""
WORDS = ["--device", "cpu", "--iters", 6]


def hear_ctrl_c():
    """As at a terminal: a job in the background is started with it ignored."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="module")
def trained(photographs, tmp_path_factory):
    """The PLY of a training of the demo's host."""
    out = tmp_path_factory.mktemp("trained")
    words = ["-s", photographs, "-m", out, "--iterations", 10, *TINY]
    succeeds("run", "--stage", "off", "--device", "cpu", "--", HOST / "train.py", *words)
    return out / "point_cloud/iteration_10/point_cloud.ply"


@pytest.fixture
def host(fork, trained, tmp_path):
    """Writes the fork's train.py, which ends with an exit code; gives the words of its command."""

    def make(photographs, code=0, shown=""):
        root = fork(root=tmp_path / "fork").root
        (root / "train.py").write_text(TRAINING.format(model=str(trained), code=code, shown=shown))
        return ["--", "python", root / "train.py", "-s", photographs, "-m", tmp_path / "out"]

    return make


def test_it_trains_as_it_is_and_its_model_learns_after(host, photographs, tmp_path, capfd):
    words, folder = host(photographs), tmp_path / "out/point_cloud/iteration_9"
    data = run_json("run", *WORDS, *words)
    assert "trained as it is" in capfd.readouterr().err  # stdout has the object alone
    assert data["adapter"] is None
    assert data["model_before"] == str(folder / "point_cloud.ply")
    assert read_ply(folder / "pruned.ply").falloff is not None
    assert read_ply(folder / "point_cloud.ply").falloff is None
    zero = run_json("run", "--stage", "finetune", "--control", *WORDS, *words)
    assert read_ply(folder / "control.ply").falloff is None
    again = run_json("run", "--stage", "finetune", "--again", *WORDS, *words)
    assert again["control"] == zero["after"]


def test_two_trainings_into_one_folder_at_once_are_refused(host, photographs, tmp_path, capfd):
    with locked(tmp_path / "out", wait=0, what="run"):
        fails("run", *WORDS, *host(photographs), says=("out: ", "another process"), code=1)
    assert "trained as it is" not in capfd.readouterr().err


def test_a_model_unlike_its_photographs_learns_from_itself(host, photographs, tmp_path, trained):
    words = host(photographs, shown="water * ")
    cameras = tmp_path / "out/cameras.json"
    cameras.parent.mkdir()
    shutil.copy(trained.parents[2] / "cameras.json", cameras)
    fails("run", *WORDS, "--control", *words, says="its training compares water", code=2)
    result = succeeds("run", "--json", *WORDS, *words)
    assert f"Cameras: {cameras}" in result.stderr
    data = json.loads(result.stdout)
    assert (data["target"], data["settings"]["itself"]) == ("itself", True)


def test_a_model_with_exposures_learns_from_its_own_pictures(host, photographs, tmp_path):
    words = host(photographs)
    (tmp_path / "out").mkdir()
    rows = [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    (tmp_path / "out/exposure.json").write_text(json.dumps({"0001": rows}))
    assert run_json("run", *WORDS, *words)["target"] == "itself"


@pytest.mark.parametrize(("old", "new"), [("/cfg_args", "/other_args"), ("source_path=", "")])
def test_without_arguments_photographs_are_read_as_we_say(host, photographs, tmp_path, old, new):
    words = host(photographs)
    edit(words[2], old, new)
    succeeds("run", *WORDS, *words, "-r", 2, "-w")
    record = beside(tmp_path / "out/point_cloud/iteration_9/pruned.ply")
    read = recorded(record).photographs
    how = {"white_background": True, "centred": True, "opaque": True}
    assert read == Photographs(photographs, Resolution(divide=2), **how)


BELOW = "/coded/name/point_cloud/iteration_1"
COPIES = f"out + '/point_cloud/iteration_9', out + {BELOW!r}, copy_function=shutil.copy"


def test_what_a_host_makes_of_its_model_in_a_folder_below_is_not_taken(host, photographs, tmp_path):
    """Self-Organizing-Gaussians compresses it, and writes what comes out again."""
    words = host(photographs)
    edit(words[2], "\nprint(", f"\nshutil.copytree({COPIES})\nprint(")
    data = run_json("run", *WORDS, *words)
    assert (tmp_path / f"out{BELOW}/point_cloud.ply").exists()
    assert data["model_before"] == str(tmp_path / "out/point_cloud/iteration_9/point_cloud.ply")


def test_a_script_in_a_folder_of_its_codebase_is_served(host, photographs, tmp_path):
    words = host(photographs)
    script = words[2]
    below = script.parent / "gs/train.py"
    below.parent.mkdir()
    finds = f"import sys\nsys.path.append({str(script.parent)!r})\nfrom scene import __name__\n"
    below.write_text(finds + script.read_text())
    (script.parent / "scene/__init__.py").write_text("")
    words[2] = below
    succeeds("run", *WORDS, *words)


def test_its_record_and_page_are_of_run_and_say_who_learned(host, photographs, tmp_path, caplog):
    caplog.set_level("INFO", logger="fragprune")
    words, out = host(photographs), tmp_path / "out"
    said = run("run", *WORDS, *words).stdout
    assert f"fragprune report {out} " in said
    assert "to see, add --stage finetune --control to the same command" in said
    assert "no adapter fits (3dgs-fork does not fit" in caplog.text
    assert "learns by vanilla 3DGS's drawing and loss" in caplog.text
    assert "fragprune finetune" in caplog.text
    assert beside(out / "point_cloud/iteration_9/pruned.ply").command == "run"
    page = run_json("report", out)
    assert page["command"] == "run"
    assert "to see, add --stage finetune --control to the same command." in page["result"]
    assert "was finished before" in run("run", *WORDS, "--stage", "finetune", *words).stdout


def test_a_training_that_fails_is_followed_by_nothing(host, photographs, tmp_path):
    said = ("exit code 3", "No adapter serves it")
    fails("run", *WORDS, *host(photographs, code=3), says=said, code=1)
    assert not list(tmp_path.rglob("pruned.ply"))


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_the_training_too(number, code, host, photographs):
    words = host(photographs)
    script = words[2]
    script.write_text(f"{script.read_text()}\n".replace("import os", WAITING, 1))
    read, write = os.pipe()
    group = os.fork()
    if not group:  # as a terminal starts it; torch is here already
        os.setsid()
        os.dup2(write, 1)
        hear_ctrl_c()
        with pytest.raises(SystemExit) as ended:
            cli.main(["run", *map(str, (*WORDS, *words))])
        os._exit(ended.value.code)
    os.close(write)
    with os.fdopen(read) as said:
        pid = int(said.readline())
        os.killpg(group, number) if number == signal.SIGINT else os.kill(group, number)
        assert os.waitstatus_to_exitcode(os.waitpid(group, 0)[1]) == code
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.usefixtures("ctrl_c")
def test_an_interrupted_second_stage_is_told_how_to_go_on(host, photographs, monkeypatch):
    words = host(photographs)
    with monkeypatch.context() as patch:
        tiny.at_loss(patch, 3, lambda: signal.raise_signal(signal.SIGINT))
        result = run("run", *WORDS, "--dropout", 0, *words)
    assert result.exit_code == 130
    assert "The same command with --stage finetune goes on from there." in result.stdout
    more = ("--dropout", 0, "--stage", "finetune")
    assert run_json("run", *more, *WORDS, *words)["resumed_at"] == 3


NO_ADAPTER = "no adapter fits"


@pytest.mark.parametrize(
    ("more", "changed", "says"),
    [
        *((("--stage", stage), {}, NO_ADAPTER) for stage in ("joint", "off")),
        (("--adapter", "3dgs-fork"), {}, NO_ADAPTER),
        ((), {"script": "\nfrom scene.flat import FlatGaussianModel\n"}, NO_ADAPTER),
        ((), {"model": "return self._xyz + self.moved"}, NO_ADAPTER),  # its PLY is not plain
        ((), {"scene": "nothing"}, "[dataset]"),
        ((), {"processes": "2"}, "several processes"),
    ],
)
def test_what_cannot_be_done_is_refused_before_the_training(
    host, photographs, tmp_path, monkeypatch, more, changed, says
):
    monkeypatch.setenv("WORLD_SIZE", changed.get("processes", "1"))
    words = host(photographs / changed.get("scene", ""))
    edit(words[2], "\nprint(", changed.get("script", "") + "\nprint(")
    model = words[2].parent / "scene/gaussian_model.py"
    edit(model, "return self._xyz", changed.get("model", "return self._xyz"))
    fails("run", *WORDS, *more, *words, says=says, code=2 if "processes" in changed else 1)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("old", "new"),
    [("shutil.copy(", "print("), ("sys.argv[2], sys.argv[4]", "sys.argv[2], 'own'")],
    ids=["none", "in another folder"],
)
def test_a_training_that_leaves_no_model_where_it_was_told_is_named(
    host, photographs, tmp_path, monkeypatch, old, new
):
    """A model of an earlier training is there, which is not taken for this one's."""
    words = host(photographs)
    edit(words[2], old, new)
    monkeypatch.chdir(tmp_path)
    earlier = tmp_path / "out/point_cloud/iteration_8/point_cloud.ply"
    earlier.parent.mkdir(parents=True)
    shutil.copy(words[2], earlier)
    os.utime(earlier, (1, 1))
    fails("run", *WORDS, *words, says=("no point_cloud.ply in", "fragprune finetune"), code=1)
    assert not list(tmp_path.rglob("pruned.ply"))
