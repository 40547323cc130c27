"""The launcher over skeleton hosts, whose training script is whatever a test wants."""

import json
import os
import shutil
import socket
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch
from miniatures.skeletons import FLAGS, skeleton

from fragprune_plugins.engines.cuda import driver
from fragprune_plugins.errors import (
    EngineError,
    HostFailed,
    HostNeedsError,
    Interrupted,
    UnknownHostError,
    UsageError,
)
from fragprune_plugins.injection import process
from fragprune_plugins.injection.command import HostCommand, split
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.injection.process import forget_modules
from fragprune_plugins.injection.starting import FINISHED
from fragprune_vanilla_3dgs import Vanilla3DGS

CPU = RunOptions(stage="off", device="cpu")


@pytest.fixture
def host(tmp_path):
    """A host's folder, and a way to say what its train.py does."""
    root = tmp_path / "host"
    skeleton(root)

    def write(code: str, name: str = "train.py") -> str:
        (root / name).write_text(code + FLAGS)
        return str(root / name)

    return write


def parsed(repo, *arguments):
    line = Vanilla3DGS().command_line(repo)
    return HostCommand(repo.root / "train.py", list(map(str, arguments)), line)


@pytest.mark.parametrize(
    "interpreter",
    ["", "python", "python3.11", "/usr/bin/python3", "python -u", "python -OO -X dev -Wignore -uB"],
)
def test_an_interpreter_in_front_and_its_options_may_be_left_out(host, interpreter, caplog):
    script = host("")
    assert split([*interpreter.split(), script, "-u", "x"]) == (Path(script), ["-u", "x"], "")
    options = interpreter.partition(" ")[2]
    said = [f"python {options}: has no effect" in message for message in caplog.messages]
    assert said == ([True] if options else [])


def test_a_module_is_found_without_importing_its_package(tmp_path, monkeypatch):
    package = tmp_path / "toyhost_of_tests"
    package.mkdir()
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    (package / "train.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    words = ["python", "-m", "toyhost_of_tests.train", "-i", "3"]
    found = (package / "train.py", ["-i", "3"], "toyhost_of_tests.train")
    assert split(words) == found
    with pytest.raises(UsageError, match="no such module"):
        split(["python", "-m", "toyhost_of_tests.evaluate"])


SITE = Path("/somewhere/site-packages")
DEMO = SITE / "fragprune_plugins/workbench/demo/host"


@pytest.mark.parametrize(
    ("root", "packages", "files", "kept"),
    [
        (
            SITE,
            ("toy",),
            {"toy": "toy/__init__.py", "toy.train": "toy/train.py"},
            {"toy._C": "toy/_C.so", "other": "other.py"},
        ),
        (
            DEMO,
            (),
            {"toy": "toy.py"},
            {"library": ".venv/lib/python3/site-packages/library.py", "other": "../other.py"},
        ),
    ],
    ids=["an installed host", "the demo's, where fragprune is installed from a wheel"],
)
def test_modules_of_a_host_are_forgotten_and_no_others(monkeypatch, root, packages, files, kept):
    for name, file in {**files, **kept}.items():
        module = ModuleType(name)
        module.__file__ = os.path.normpath(root / file)
        monkeypatch.setitem(sys.modules, name, module)
    forget_modules(root, sys.modules.keys() - {*files, *kept}, packages)
    assert [name for name in {**files, **kept} if name in sys.modules] == list(kept)


def test_any_spelling_of_a_flag_is_read_and_the_last_is_written(tmp_path):
    line = replace(
        Vanilla3DGS().command_line(skeleton(tmp_path)),
        iterations=("-i", "--iteration"),
        resume=("-l", "--load_ply"),
    )
    host = HostCommand(tmp_path / "train.py", ["-i", "7", "-l", "a.ply"], line)
    assert (host.flags.iterations, host.flags.resume) == (7, "a.ply")
    written = [line.spellings(field)[-1] for field in ("iterations", "output", "resume")]
    assert written == ["--iteration", "--model_path", "--load_ply"]


@pytest.mark.parametrize(
    "command", [[], ["python"], ["python", "-m", "train"], ["bash", "run.sh"], ["missing.py"]]
)
def test_a_command_without_a_script_is_a_usage_error(command):
    with pytest.raises(UsageError):
        split(command)


@pytest.mark.parametrize(
    "words",
    [
        ["-m", "out", "-s", "data", "--iterations", "70", "--start_checkpoint", "c.pth"],
        ["-mout", "-sdata", "--iterations=70", "--start_checkpoint=c.pth"],
        ["--model_path", "out", "--source_path=data", "--iter", "70", "--start", "c.pth"],
        ["--iter=9", "-m", "x", "-m", "out", "-s", "data", "--iter", "70", "--start=c.pth"],
    ],
    ids=["plain", "joined", "abbreviated", "given twice"],
)
@pytest.mark.parametrize("extra", [[], ["--eval", "-r", "2", "--test_iterations", "-1", "7"]])
def test_the_few_flags_we_need_are_read_as_the_host_will(tmp_path, words, extra):
    flags = parsed(skeleton(tmp_path), *words, *extra).flags
    assert (flags.output, flags.source, flags.iterations) == ("out", "data", 70)
    assert flags.resume == "c.pth"


def test_added_flags_come_last_and_so_win(tmp_path):
    host = parsed(skeleton(tmp_path), "--iterations", 5, "--checkpoint_iterations", 2, 3)
    assert host.flags.save_checkpoints == [2, 3]
    words = host.with_flags(tmp_path, iterations=9, save_checkpoints=[2, 3, 5])
    assert words[-6:] == ["--iterations", "9", "--checkpoint_iterations", "2", "3", "5"]
    assert host.arguments[-1] == "3"


def test_a_flag_with_an_impossible_value_is_a_usage_error(tmp_path):
    with pytest.raises(UsageError, match="iterations"):
        parsed(skeleton(tmp_path), "--iterations", "many")


NOTES = """
import json, sys
from pathlib import Path
import neighbour
Path(sys.argv[1]).write_text(json.dumps([sys.argv, sys.path[0], __name__, __file__]))
sys.path.append("/left/behind")
sys.argv.append("left behind")
sys.stdout = None
"""


def test_the_script_sees_a_fresh_interpreter_and_leaves_ours_as_it_was(host, tmp_path):
    script = host(NOTES)
    host("", name="neighbour.py")
    before = sys.argv[:], sys.path[:], sys.stdout, sys.stderr
    summary = run(["python", script, str(tmp_path / "notes")], CPU)
    assert (sys.argv, sys.path, sys.stdout, sys.stderr) == before
    argv, first, name, file = json.loads((tmp_path / "notes").read_text())
    assert (argv, first) == ([script, str(tmp_path / "notes")], str(Path(script).parent))
    assert (name, file) == ("__main__", script)
    assert "neighbour" not in sys.modules
    assert (summary.stage, summary.steps, summary.device) == ("off", 0, "cpu")


INSTALL = (
    "what the host itself imports. Install as the host's own instructions say: absent_of_tests"
)


@pytest.mark.parametrize(
    ("code", "error", "says"),
    [
        ("sys.exit(3)", HostFailed, "3"),
        ("sys.exit('no data')", HostFailed, "no data"),
        ("def late():\n    import absent_of_tests.core\nlate()", HostFailed, INSTALL),
        (  # what torch refuses it on a CPU is not said to be ours
            "import torch\ntorch.zeros(2)[torch.ones(3, dtype=torch.bool)]",
            HostFailed,
            r"train\.py:3 .*Read the traceback above\.$",
        ),
        ("raise KeyboardInterrupt", Interrupted, r": Ctrl-C; .*\. Run the command again\.$"),
    ],
)
def test_a_hosts_own_failure_is_passed_on(host, code, error, says):
    before = sys.stdout
    with pytest.raises(error, match=says):
        run([host(f"import sys; sys.stdout = None\n{code}")], CPU)
    assert sys.stdout is before


@pytest.mark.parametrize("end", ["sys.exit()", "sys.exit(0)", ""])
def test_a_host_that_ends_well_is_no_failure(host, end):
    run([host(f"import sys; {end}")], CPU)


def test_a_hosts_exception_is_told_in_a_line_and_nothing_stays_patched(host, capsys):
    host("def fail():\n    raise KeyError('theirs\\nand more')", name="neighbour.py")
    script = host("import diff_gaussian_rasterization, scene, neighbour\nneighbour.fail()")
    with pytest.raises(HostFailed) as caught:
        run([script], CPU)
    assert caught.value.where == "neighbour.py:2 in fail"
    assert caught.value.found == r"KeyError: 'theirs\nand more'"
    assert isinstance(caught.value.__cause__, KeyError)
    stderr = capsys.readouterr().err
    assert stderr.startswith("Traceback (most recent call last)")
    assert f"{script}" in stderr
    assert not {"scene", "diff_gaussian_rasterization"} & set(sys.modules)


FULL = "CUDA out of memory. Tried to allocate 2.00 GiB."


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ModuleNotFoundError("No module named 'a'", name="a"), "'a'.*fragprune raised it"),
        (torch.cuda.OutOfMemoryError(FULL), r"2\.00 GiB.*Free memory of the GPU, or need less"),
    ],
    ids=["a package that is missing", "a GPU that is full"],
)
def test_what_our_own_code_raises_is_not_said_to_be_the_hosts(host, monkeypatch, error, said):
    def raises(*_):
        raise error

    monkeypatch.setattr(process, "_OURS", Path(__file__).parent)
    monkeypatch.setattr(torch, "median", raises)
    with pytest.raises(HostFailed, match=said):
        run([host("import torch\ntorch.median(0)")], CPU)


def test_what_a_host_imports_and_reads_is_looked_at_before_it_runs(host, tmp_path):
    """All at once, not one traceback after the other."""
    host("import icecream_of_tests", name="neighbour.py")
    script = host("raise SystemExit('it ran')\nimport neighbour, cv2_of_tests")
    with pytest.raises(HostNeedsError) as caught:
        run([script, "-s", str(tmp_path / "nowhere")], CPU)
    assert "cv2_of_tests (train.py:2), icecream_of_tests (neighbour.py:1)" in caught.value.found
    assert f"no folder {tmp_path / 'nowhere'}" in caught.value.found
    assert "instructions say: cv2_of_tests, icecream_of_tests" in caught.value.remedy


def test_the_hosts_script_may_be_named_as_a_module_of_its_folder(host, monkeypatch):
    script = Path(host("import sys; sys.exit('it ran')"))
    monkeypatch.chdir(script.parent)
    with pytest.raises(HostFailed, match="it ran"):
        run(["python", "-m", "train"], CPU)
    with pytest.raises(UsageError, match="no such module"):
        run(["python", "-m", "evaluate"], CPU)


@pytest.mark.parametrize("arguments", [[], ["-m", "empty"]])
def test_nothing_to_start_from_says_what_to_name(host, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=r"no model in.*; expected.*--start_checkpoint"):
        run([host("raise SystemExit(9)"), *arguments], RunOptions(stage="finetune", device="cpu"))


def test_a_checkpoint_that_is_not_there_is_a_usage_error(host):
    command = [host("raise SystemExit(9)"), "--start_checkpoint", "nowhere.pth"]
    with pytest.raises(UsageError, match="no such file"):
        run(command, RunOptions(stage="auto", device="cpu"))


STAGES = """
import argparse, torch
from pathlib import Path
parser = argparse.ArgumentParser()
parser.add_argument("-m")
parser.add_argument("--iterations", type=int, default=12_345)
parser.add_argument("--checkpoint_iterations", type=int, nargs="+", default=[])
parser.add_argument("--start_checkpoint")
args = parser.parse_args()
out = Path(args.m)
out.mkdir(exist_ok=True)
with (out / "log").open("a") as log:
    print(args.iterations, args.checkpoint_iterations, args.start_checkpoint, file=log)
if args.start_checkpoint:
    assert torch.load(args.start_checkpoint)[1] == 12_345
for iteration in args.checkpoint_iterations:
    torch.save(((), iteration), out / f"chkpnt{iteration}.pth")
"""


def test_stage_one_is_asked_for_a_checkpoint_and_stage_two_resumes_it(host, tmp_path):
    """The number of iterations is nowhere on the command line: it is read from the source.

    Stage 2 has one more than asked for: the host takes no step in its last.
    """
    from fragprune_plugins.learning.schedule import Settings

    out, log = tmp_path / "out", tmp_path / "out/log"
    options = RunOptions(device="cpu", settings=Settings(iterations=100))
    run([host(STAGES), "-m", str(out)], options)
    checkpoint = out / "chkpnt12345.pth"
    assert log.read_text().splitlines() == ["12345 [12345] None", f"12446 [] {checkpoint}"]
    log.unlink()
    run([host(STAGES), "-m", str(out), "--start_checkpoint", str(checkpoint)], options)
    assert log.read_text().splitlines() == [f"12446 [] {checkpoint}"]


AUTO = RunOptions(device="cpu", again=False)
INTERRUPTED = """
if args.start_checkpoint and not (out / "no").exists():
    raise KeyboardInterrupt
"""
SCENE = """
class Scene:
    def __init__(self, args, gaussians):
        self.model_path = args.m
"""


@pytest.fixture
def interrupted(host, tmp_path):
    """A command that got Ctrl-C in stage 2, and the error; later runs of it read its log."""
    out = tmp_path / "out"
    words = [host(STAGES + INTERRUPTED), "-m", str(out)]
    with pytest.raises(Interrupted) as caught:
        run(words, AUTO)
    (out / "no").touch()
    (out / "log").unlink()
    return words, out, caught.value


@pytest.mark.parametrize("stage", ["auto", "finetune"])
def test_after_ctrl_c_in_stage_two_stage_one_is_not_repeated(interrupted, stage):
    words, out, error = interrupted
    checkpoint = out / "chkpnt12345.pth"
    assert error.remedy == f"Run the command again: stage 2 begins anew from {checkpoint}."
    stage_two = f"17346 [] {checkpoint}"
    named = ["--start_checkpoint", str(checkpoint)] if stage == "finetune" else []
    run([*words, *named], replace(AUTO, stage=stage))
    assert (out / "log").read_text().splitlines() == [stage_two]
    run(words, AUTO)  # both stages are finished by now
    assert (out / "log").read_text().splitlines() == [stage_two, "12345 [12345] None", stage_two]


@pytest.mark.parametrize("changed", ["the command", "the script", "the checkpoint", "a wish"])
def test_stage_one_is_repeated_where_it_may_be_another(interrupted, monkeypatch, changed):
    words, out, _ = interrupted
    options = replace(AUTO, again=changed == "a wish")
    if changed == "the command":
        words = [*words, "--iterations", "12345"]
    elif changed == "the script":
        words[0] = shutil.copy(words[0], words[0].replace("train.py", "train2.py"))
        monkeypatch.setattr(Vanilla3DGS, "scripts", ("train.py", "train2.py"))
    elif changed == "the checkpoint":
        os.utime(out / "chkpnt12345.pth", ns=(1, 1))
    run(words, options)
    first, _ = (out / "log").read_text().splitlines()
    assert first.endswith("[12345] None")


FAILS_AFTERWARDS = """
if not args.start_checkpoint:
    raise KeyError("ours_30000")  # an evaluation that looks for another iteration
"""


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # its socket
def test_a_training_whose_evaluation_fails_goes_on_to_stage_two(host, tmp_path, caplog):
    out = tmp_path / "out"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    host(f"import socket\nopen = socket.create_server(('127.0.0.1', {port}))", "network_gui.py")
    run([host(f"import network_gui\n{STAGES}{FAILS_AFTERWARDS}"), "-m", str(out)], AUTO)
    checkpoint = out / "chkpnt12345.pth"
    assert (out / "log").read_text().splitlines()[1] == f"17346 [] {checkpoint}"
    (said,) = (each.message for each in caplog.records if "ours_30000" in each.message)
    assert f"had saved {checkpoint} when it failed" in said


FULL_DISK = """
if not args.start_checkpoint:
    import os
    os.truncate(out / f"chkpnt{iteration}.pth", 300)
    raise OSError("No space left")
"""


@pytest.mark.parametrize(
    ("code", "says"),
    [
        (STAGES + FULL_DISK, "No space left"),
        (STAGES.replace("for iteration", "raise KeyError('early')\nfor iteration"), "early"),
    ],
    ids=["its last checkpoint is cut off", "before its last checkpoint"],
)
def test_a_training_that_fails_is_no_end_of_stage_one(host, tmp_path, code, says):
    out = tmp_path / "out"
    with pytest.raises(HostFailed, match=says):
        run([host(code), "-m", str(out)], AUTO)
    assert len((out / "log").read_text().splitlines()) == 1
    assert not (out / FINISHED).exists()


def test_a_stage_two_that_fails_after_it_saved_names_the_model(host, tmp_path):
    ply = "point_cloud/iteration_17346/point_cloud.ply"
    saves = f"""
if args.start_checkpoint:
    (out / "{ply}").parent.mkdir(parents=True)
    (out / "{ply}").touch()
    tick = time.time() - 0.05  # a file has the time of the kernel's last tick, or an earlier one
    os.utime(out / "{ply}", (tick, tick))
    raise KeyError("ours_30000")
"""
    saves = f"import os, time\n{saves}"
    with pytest.raises(HostFailed, match="ours_30000") as caught:
        run([host(STAGES + saves), "-m", str(tmp_path / "out")], AUTO)
    assert f"learned model was saved: {tmp_path / 'out' / ply}" in caught.value.remedy


def test_after_ctrl_c_a_folder_that_only_the_host_named_is_named(host, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    host(SCENE, "scene/__init__.py")
    named = STAGES.replace('"-m"', '"-m", "--model_path", dest="m", default="named"')
    words = [host(f"{named}\nimport scene\nscene.Scene(args, 0)\n{INTERRUPTED}")]
    with pytest.raises(Interrupted) as caught:
        run(words, AUTO)
    assert "with --stage finetune and --model_path named: stage 2" in caught.value.remedy


def test_a_gpu_that_no_engine_of_ours_draws_on_is_refused_first(host, tmp_path, monkeypatch):
    script = host(f"open({str(tmp_path / 'trained')!r}, 'w')\n")
    monkeypatch.setattr(process, "host_device", lambda wanted, engine: "cuda")
    monkeypatch.setattr(driver, "missing", lambda: "no NVRTC library")
    with pytest.raises(EngineError, match="no NVRTC library"):
        run([script, "-s", str(tmp_path), "-m", str(tmp_path / "out")], RunOptions())
    assert not (tmp_path / "trained").exists()


def test_a_script_of_no_host_is_refused_before_it_runs(tmp_path):
    (tmp_path / "train.py").write_text("raise SystemExit('it ran')")
    with pytest.raises(UnknownHostError):
        run([str(tmp_path / "train.py")], CPU)
