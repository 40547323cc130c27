"""``fragprune check`` says what is where, what changed, and what a codebase is not."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from cli.commands import fails, run, run_error, run_json, succeeds
from core.test_verdict import fork as fork  # a fixture
from miniatures.runs import edit
from miniatures.skeletons import skeleton

from fragprune_plugins.adapting import HostRepo, Role, Seam
from fragprune_plugins.testing import mutations
from fragprune_plugins.workbench import demo
from fragprune_plugins.workbench.check import work
from fragprune_vanilla_3dgs import Vanilla3DGS

MINIATURE = Path(demo.__file__).with_name("host")
MODEL, RENDERER = "scene/gaussian_model.py", "gaussian_renderer/__init__.py"


@pytest.fixture
def host(tmp_path):
    return mutations.copy_source(HostRepo(MINIATURE), tmp_path).root


def of(report, name="vanilla-3dgs"):
    return next(each for each in report["adapters"] if each["adapter"] == name)


def refused(host, *words):
    result = run("check", host, *words, "--json")
    assert result.exit_code == 1
    report = json.loads(result.stdout)
    assert report["fits"] is None
    return report


def line_of(host, file, text):
    lines = (host / file).read_text().splitlines()
    return next(number for number, line in enumerate(lines, 1) if text in line)


def test_the_host_that_fits_with_every_seam_in_its_place(host):
    report = run_json("check", host)
    assert report["fits"] == report["adapters"][0]["adapter"] == "vanilla-3dgs"
    best = report["adapters"][0]
    assert best["seams_held"] == best["seams_looked_up"] > 10
    for seam in best["seams"]:
        assert seam["status"] in ("found", "at import")
        if seam["status"] == "found":
            file, line = seam["at"].split(":")
            name = seam["seam"].split(":")[1].split(".")[-1]
            assert f"def {name}(" in (host / file).read_text().splitlines()[int(line) - 1]
    text = succeeds("check", host, "--adapter", "vanilla-3dgs")
    assert f"{MODEL}:{line_of(host, MODEL, 'def _prune_optimizer')}" in text.stdout
    assert f"fragprune run -- python {host / 'train.py'}" in text.stdout
    alone = succeeds("check", host).stdout
    assert alone.splitlines()[4].startswith("vanilla-3dgs fits: ")
    assert "does not fit" not in alone  # no line of any other adapter
    assert "others do not fit (--adapter NAME says why)" in alone


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("prune(threshold, 0.005", "clone(grads", "densify_and_clone, which changes the model"),
        ("restore(model_params, opt)", "load_ply(checkpoint)", "train.py has no restore"),
        ("optimizer.step()", "optimizer.step(); gaussians._xyz = loss", "changes _xyz outside"),
        ("= GaussianModel(", "= OtherModel(", "train.py makes OtherModel"),
        ("loss.backward()", "loss.backward(", "train.py is no valid Python"),
        ("loss.backward()", "loss.backward(); loss.backward()", "2 places that go back"),
    ],
)
def test_a_script_with_other_steps_is_not_vanillas(host, old, new, found):
    edit(host / "train.py", old, new)
    report = refused(host)
    assert report["verdict"] == "finetune"
    learns = "--self" if "no valid" in found else "--data SCENE"  # its loss cannot be read
    assert learns in report["sentence"]
    assert found in str(report["differs"])


def test_one_with_a_further_training_script_is_left_to_the_adapter_that_reads_them_all(host):
    (host / "train_more.py").write_text((host / "train.py").read_text())
    assert "train_more.py: another training script" in str(refused(host)["differs"])


CHECKED = """
import json, sys
from click.testing import CliRunner
from fragprune_plugins.workbench.commands import cli
result = CliRunner().invoke(cli, ["check", sys.argv[1], "--json"])
print(json.dumps([result.exit_code, "torch" in sys.modules, "scene" in sys.modules]))
"""


def test_nothing_is_imported(host, python):
    for file in host.rglob("*.py"):
        file.write_text(file.read_text() + "\nraise SystemExit('imported')\n")
    assert python(CHECKED, host) == [0, False, False]


def test_one_that_fits_none_has_the_whole_reason_of_each_of_the_nearest(host):
    mutations.rename_function(HostRepo(host), KEEP)
    lines = [line for line in run("check", host).stdout.splitlines() if "does not fit" in line]
    assert lines[0].startswith("3dgs-fork does not fit: ")
    assert len(lines) == 3
    why = "12 of 13 seams hold; no GaussianModel._prune_optimizer"
    assert lines[1].startswith(f"vanilla-3dgs does not fit: {why}")
    assert not any(line.endswith("...") for line in lines)


def test_packages_that_it_imports_and_that_are_not_here_are_listed(host):
    renderer = host / RENDERER
    renderer.write_text("import open3d, clip_of_tests\n" + renderer.read_text())
    report = run_json("check", host)
    assert report["fits"] == "vanilla-3dgs"
    missing = [(each["module"], each["at"]) for each in report["missing"]]
    assert missing == [(name, f"{RENDERER}:1") for name in ("open3d", "clip_of_tests")]
    ways = ("Run: pip install open3d", "Install as the host's own instructions say: clip_of_tests")
    assert "".join(f"  {way}\n" for way in ways) in run("check", host).stdout


KEEP = Seam(Role.KEEP, "scene.gaussian_model", "GaussianModel._prune_optimizer")


def test_a_dropped_parameter_is_named_where_the_method_is(host):
    line = line_of(host, MODEL, "def _prune_optimizer(")
    mutations.rename_parameter(HostRepo(host), KEEP, "mask")
    report = of(refused(host))
    (error,) = [f for f in report["findings"] if f["level"] == "error"]
    assert (error["code"], error["where"]) == ("seam-signature", f"{KEEP} ({MODEL}:{line})")
    assert error["expected"] == "also mask"
    text = run("check", host, "--adapter", "vanilla-3dgs").stdout
    assert f"CHANGED at {MODEL}:{line}: parameters (" in text


def test_an_ancestor_of_the_host_steps_back_and_says_so(tmp_path, monkeypatch):
    class Fork(Vanilla3DGS):
        name, descends_from = "fork", ("vanilla-3dgs",)

    plugins = SimpleNamespace(adapters=[Vanilla3DGS(), Fork()])
    monkeypatch.setattr(work, "load_plugins", lambda: plugins)
    skeleton(tmp_path)
    assert run_json("check", tmp_path)["fits"] == "fork"
    said = run("check", tmp_path).stdout
    assert "fork fits" in said
    assert "vanilla-3dgs fits: 13 of 13 seams hold; fork descends from it" in said
    assert "Use: fragprune run" in said


def test_a_folder_that_is_no_host(tmp_path):
    (tmp_path / "train.py").write_text("print('another project')")
    report = refused(tmp_path)
    assert all(each["seams_held"] == 0 for each in report["adapters"])
    text = run("check", tmp_path).stdout
    assert "adapters knows anything of it" in text
    assert "python -m pydoc fragprune_plugins.adapting" in text  # an installed package has no docs/
    assert "docs/" not in text


def test_what_a_training_wrote_is_not_judged_as_a_host(tmp_path):
    (tmp_path / "cfg_args").touch()
    fails("check", tmp_path, says=("the output folder of a training", "fragprune audit"), code=1)
    (tmp_path / "train.py").touch()  # its checkout, to which a training wrote
    assert "the output folder" not in refused(tmp_path)["reason"]


def test_a_folder_whose_scripts_use_the_one_above_names_it(host):
    inner = host / "variant"
    inner.mkdir()
    (inner / "train.py").write_text("import scene\n")
    result = run("check", inner)
    assert result.exit_code == 1
    sentence = result.stdout.splitlines()[2]
    assert sentence.startswith("Its scripts use the folder above, which fits vanilla-3dgs")
    assert f"fragprune check {host}" in sentence
    assert "To write an adapter" not in result.stdout


def test_so_does_one_below_a_fork_whose_ply_is_plain(fork, tmp_path):
    root = fork().root
    (root / "gs").mkdir()
    (root / "gs/train.py").write_text("import scene\n")
    lines = run("check", root / "gs").stdout.splitlines()
    assert lines[2] == (
        "Its scripts use the folder above, which saves plain 3DGS, as run finds: "
        f"fragprune check {tmp_path}"
    )
    assert run("check", root).stdout.splitlines()[2].startswith("No adapter fits, but its PLY")


def test_a_fork_that_does_not_fit_is_told_once_why(tmp_path):
    """The nearest adapter speaks for all that look for the same."""
    skeleton(tmp_path, groups=("xyz", "color", "albedo"))
    lines = run("check", tmp_path).stdout.splitlines()
    (said,) = [line for line in lines if "albedo" in line]
    assert said.startswith("  further groups of the optimizer: color, albedo; ")
    assert "others do not fit (--adapter NAME says why)." in lines[-3]


def test_a_folder_that_fits_is_the_last_word(tmp_path):
    skeleton(tmp_path / "inner")
    assert run("check", tmp_path).stdout.endswith(f"fragprune check {tmp_path / 'inner'}\n")


def test_an_adapter_can_be_asked_for(host):
    report = refused(host, "--adapter", "light_gaussian")
    assert [each["adapter"] for each in report["adapters"]] == ["light-gaussian"]
    assert run_json("check", host, "--adapter", "vanilla-3dgs")["fits"] == "vanilla-3dgs"


def test_unknown_folders_and_adapters_are_stated_failures(host, tmp_path):
    words = ("check", "--json")
    assert "neither a folder nor" in run_error(*words, tmp_path / "nowhere")["found"]
    assert "'my-host'" in run_error(*words, host, "--adapter", "my-host")["found"]


def test_several_checkouts_are_a_table(tmp_path):
    skeleton(tmp_path / "a")
    skeleton(tmp_path / "b", groups=("xyz", "color"))
    (tmp_path / "empty").mkdir()
    hosts = [tmp_path / name for name in ("a", "b", "empty")]
    result = run("check", *hosts)
    rows = [line.split(" | ") for line in result.stdout.splitlines() if line.startswith("| ")][1:]
    assert [(r[0], r[1]) for r in rows] == [("| a", "fits"), ("| b", "never"), ("| empty", "never")]
    assert "further groups of the optimizer: color" in rows[1][-1]
    counts = json.loads(run("check", *hosts, "--json").stdout)["counts"]
    assert (counts["fits"], counts["never"]) == (1, 2)
