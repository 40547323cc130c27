"""The whole demo, very small, in a process of its own as a user starts it."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cli.commands import run_json

from fragprune_plugins.workbench.demo import folder
from fragprune_plugins.workbench.demo.work import BANNER, DemoSettings, host_command
from fragprune_plugins.workbench.figures.wording import headlines, outcome

TINY = """
import json, sys
from pathlib import Path
from fragprune_plugins.workbench.demo import folder
from fragprune_plugins.workbench.demo.work import DemoSettings, run_demo
settings = DemoSettings(iterations=30, finetune=12, views=12, width=48, points=400)
print(json.dumps(run_demo(Path(sys.argv[1]), settings)))
"""


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo") / "out"
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
        "OMP_WAIT_POLICY": "PASSIVE",
    }
    result = subprocess.run(
        [sys.executable, "-c", TINY, str(out)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return out, json.loads(result.stdout), result.stderr


def test_report_has_the_names_of_every_report(demo):
    out, report, _ = demo
    for side in ("before", "after", "control"):
        assert {
            *("psnr", "ssim", "lpips", "fragments_per_pixel", "evaluated_per_pixel", "gaussians"),
            *("frame_ms", "frame_ms_se"),
        } <= report[side].keys()
    assert report["after"]["fragments_per_pixel"] < report["before"]["fragments_per_pixel"]
    assert report["iterations"] == 12
    assert report["keep"] is not None
    assert report["after"]["gaussians"] < report["before"]["gaussians"]
    assert report["adapter"] == "vanilla-3dgs"
    assert report["device"] == "cpu"
    saved = json.loads((out / "report.json").read_text())
    assert saved == report


def test_control_shows_what_as_many_iterations_give_without_pruning(demo):
    _, report, _ = demo
    gain = report["control"]["psnr"] - report["before"]["psnr"]
    assert gain != 0
    assert report["control"]["gaussians"] == report["before"]["gaussians"]
    assert f"{gain:+.2f} dB: pruning itself makes" in outcome("run", report, report["control"])


def test_the_control_is_the_hosts_own_training_resumed_from_the_same_checkpoint(demo):
    out, report, _ = demo
    (control,) = (out / "model" / "control").rglob("point_cloud.ply")
    measured = run_json("compare", report["model_before"], control, "--data", out / "scene")
    assert measured["b"]["psnr"] == pytest.approx(report["control"]["psnr"], abs=1e-4)


def test_pictures_and_page_are_there(demo):
    out, report, _ = demo
    for file in report["files"]:
        assert (out / file).stat().st_size > 0
    page = (out / "index.html").read_text()
    for file in report["files"]:
        assert file in page or file in ("index.html", f"pictures/{BANNER}")
    (_, (_, said), _) = headlines(report, report["control"])  # the frame times of its sentence
    assert said in page
    assert Path(report["model_after"]).exists()


def test_report_shows_the_demos_folder(demo, tmp_path):
    out, demos, _ = demo
    report = run_json("report", out, "--out", tmp_path / "page.html")
    assert (report["command"], report["adapter"]) == ("run", "vanilla-3dgs")
    assert report["after"] == demos["after"]
    assert report["result"].endswith(outcome("run", demos, demos["control"]))
    (note,) = report["notes"]
    assert note in (out / "index.html").read_text()
    assert "Gaussians before learning" in note
    assert len(report["views"]) > 0
    text = (tmp_path / "page.html").read_text()
    assert text.count('src="data:image/png;base64,') == report["pictures"] > 7


def test_all_of_it_is_the_next_demos_to_delete(demo, tmp_path):
    out = shutil.copytree(demo[0], tmp_path / "out")
    folder.clear(out)
    assert [path.name for path in out.iterdir()] == [folder.MARKER]


def test_progress_is_on_stderr_throughout(demo):
    _, _, stderr = demo
    assert stderr.count("Training") >= 2


def test_command_is_one_a_user_could_type():
    command = host_command(Path("scene"), Path("model"), DemoSettings(iterations=500, seed=4))
    assert Path(command[0]).name == "train.py"
    assert command[command.index("--iterations") + 1] == "500"
    assert command[command.index("--densify_until_iter") + 1] == "325"
    assert command[command.index("--seed") + 1] == "4"
    assert command[-1] == "--eval"
