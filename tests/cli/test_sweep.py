"""fragprune run in front of a script that starts trainings: each one is served."""

import contextlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
from cli.commands import fails, run
from cli.test_run_afterwards import TRAINING, WAITING, hear_ctrl_c
from core.test_verdict import fork as fork  # a fixture
from miniatures.runs import TINY
from miniatures.vanilla_3dgs import HOST

from fragprune_plugins.files import sidecar
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.run import started, sweep
from fragprune_plugins.workbench.run.recognising import is_sweep
from fragprune_plugins.workbench.run.sweep import OPTIONS, STOPPED

FULL_EVAL = """
import os

for scene in ("room", "garden"):
    os.system("python train.py -s " + scene)
"""


def script_of(folder, text, name="sweep.sh"):
    path = folder / name
    path.write_text(text)
    return path


def test_each_script_of_a_host_is_served_and_other_python_is_python(
    photographs, tmp_path, monkeypatch, capfd
):
    train = ["python", "train.py", "-s", photographs, "-m", tmp_path / "out", "--iterations", 10]
    (tmp_path / "plain.py").write_text("import sys; print('fragprune_plugins' in sys.modules)")
    (tmp_path / "quick.toml").write_text("iters = 4\n")
    lines = [
        f"cd {HOST}  # or conda activate",
        f"A=1 {shlex.join(map(str, [*train, *TINY]))}",
        f"mkdir {tmp_path}/out/point_cloud/iteration_9",  # of an earlier run
        f"cp {tmp_path}/out/point_cloud/iteration_1[1-9]/* {tmp_path}/out/point_cloud/iteration_9",
        f"touch -d 2000-01-01 {tmp_path}/out/point_cloud/iteration_9/point_cloud.ply",
        f"python3 render.py -m {tmp_path}/out --iteration 10 2> {tmp_path}/hidden",
        f"python {tmp_path}/plain.py > {tmp_path}/said",
        "python -c 'import sys; sys.exit(7)'",
    ]
    script = script_of(tmp_path, "\n".join(lines))
    monkeypatch.chdir(tmp_path)
    words = ["--config=quick.toml", "--json", "--device", "cpu", "--", "bash", script]
    result = run("run", *words)
    assert result.exit_code == 7, result.stderr
    assert (tmp_path / "said").read_text() == "False\n"
    data = json.loads(result.stdout)
    served, drawn = data["runs"]
    assert "the pruned model" in drawn["warnings"][0]
    assert served["report"]["model_after"] in drawn["warnings"][0]
    assert data["exit_code"] == 7
    assert (served["exit_code"], served["report"]["iterations"]) == (0, 4)
    assert sidecar.find(Path(served["report"]["model_after"]))
    assert "fewer fragments" not in capfd.readouterr().out  # stdout has the object alone


def as_nohup():
    """A lost terminal is ignored, and so it is by all that is started."""
    hear_ctrl_c()
    signal.signal(signal.SIGHUP, signal.SIG_IGN)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_what_runs_and_nothing_more_starts(number, code, fork, photographs, tmp_path):
    """A shell has its background ignore Ctrl-C. Another training needs a while to end."""
    root = fork(root=tmp_path / "fork").root
    training = TRAINING.format(model="none", code=0, shown="").replace("import os", WAITING, 1)
    (root / "train.py").write_text(training)
    slow = "import signal, sys\n"
    slow += "signal.signal(signal.SIGTERM, lambda *_: time.sleep(1) or sys.exit())\n"
    (root / "train_slow.py").write_text(training.replace("\nprint", f"\n{slow}print", 1))
    words = f"-s {photographs} -m {tmp_path}/out\n"
    trains = f"python {root}/train.py {words}"
    inner = f"{trains}touch {tmp_path}/after\n{trains}"
    lines = "nohup sleep 90 &\npython -c 'import time; time.sleep(60)' &\n"
    lines += f"sh {script_of(tmp_path, inner, 'inner.sh')} &\n"
    lines += f"python {root}/train_slow.py -s {photographs} -m {tmp_path}/slow\n"
    script = script_of(tmp_path, f"{lines}touch {tmp_path}/after\n{trains}")
    line = [sys.executable, "-m", "fragprune_plugins", "run", "--device", "cpu", "--", "sh", script]
    how = {"stdout": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen(list(map(str, line)), **how, preexec_fn=as_nohup) as run_:
        pids = [int(run_.stdout.readline()) for _ in range(2)]
        run_.send_signal(number)
        assert run_.wait(60) == code
        assert not run_.communicate(timeout=30)[0]  # nobody is left who holds it
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    assert not (tmp_path / "after").exists()


def test_what_is_in_the_background_is_waited_for_and_a_killed_one_is_told(photographs, tmp_path):
    """Within a sweep in a sweep: a script of Python starts one of the shell."""
    root = shutil.copytree(HOST, tmp_path / "host")
    killed = "import os, time\ntime.sleep(1)\nos.kill(os.getpid(), 9)\n"
    (root / "train.py").write_text(killed + (HOST / "train.py").read_text())
    inner = f"import os\nos.system('cd {root} && python -u train.py -s {photographs} -m b &')\n"
    script_of(tmp_path, inner, "all.py")
    script = script_of(tmp_path, f"python {tmp_path}/all.py\n")
    result = run("run", "--device", "cpu", "--", script)
    assert result.exit_code == 1, result.stderr
    assert "\n    was killed\n" in result.stdout, result.stdout
    assert "0 of 1 commands of a host ended well." in result.stdout


def test_a_temporary_folder_may_forbid_programs(tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, mode: mode != os.X_OK)
    fails("run", "--", script_of(tmp_path, "python train.py"), says="Set TMPDIR")


def test_options_of_the_interpreter_are_lost_only_where_it_is_ours(tmp_path, caplog):
    script = script_of(tmp_path, "print(1)", "plain.py")
    assert not started._is_served(["-u", str(script)])
    assert not caplog.text


@pytest.mark.parametrize(
    ("text", "more", "says", "code"),
    [
        ("python -c 'print(1)'", (), "started no script of a host by the word python", 1),
        ("python train.py", ("--log", "csv:{}/steps.csv"), "one training", 2),
    ],
)
def test_what_is_no_sweep_of_trainings_is_refused(tmp_path, text, more, says, code):
    more = [word.format(tmp_path) for word in more]
    fails("run", *more, "--", script_of(tmp_path, text), says=says, code=code)


@pytest.mark.parametrize(
    "line",
    [
        *("source activate gs", "  conda activate gs && python train.py", "uv run train.py"),
        *("/opt/gs/bin/python train.py", "torchrun --nproc-per-node 2 train.py"),
        *("python -m torch.distributed.run train.py", "env -i python train.py"),
        'export PATH="$ENV/bin:$PATH"',
    ],
)
def test_what_would_start_another_python_is_refused_before_anything(line, tmp_path):
    script = script_of(tmp_path, f"touch {tmp_path}/ran\n{line}\n")
    fails("run", "--", "bash", script, says=(repr(line.strip()), "in front of each training"))
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("starts", ['sys.executable + " train', '"torchrun train'])
def test_so_is_it_in_a_script_of_python(starts, tmp_path):
    script = script_of(tmp_path, FULL_EVAL.replace('"python train', starts), "all.py")
    fails("run", "--", script, says=starts.strip('"').split(" + ")[0])


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("", "", True),
        ("os.system", "subprocess.run", True),
        ("os.system", "print", False),
        ("train.py", "render.py", False),
        ("import os", "import os\nloss.backward()", False),
        ("import os", "import os\nfrom scene import GaussianModel", False),  # it draws itself
        ('" + scene', '" + scene + " MODEL.PATH=out"', True),
    ],
)
def test_a_sweep_starts_trainings_and_trains_nothing(old, new, expected, tmp_path):
    script = script_of(tmp_path, FULL_EVAL.replace(old, new), "all.py")
    assert is_sweep(["python", str(script)]) == expected
    assert is_sweep([str(script), "--scene", "room"]) == expected


@pytest.mark.parametrize("between", [(), ("--",)])
def test_words_behind_the_script_are_its_own(between, tmp_path, monkeypatch):
    asked = []

    def swept(command, options, **_):
        asked.append(([*command], [each for each in options if each != "--"]))
        return Report({}, "")

    monkeypatch.setattr("fragprune_plugins.workbench.run.sweep.run_sweep", swept)
    run("run", "--quick", *between, "all.sh", "--", "room")
    assert asked == [(["all.sh", "--", "room"], ["--quick"])]


@pytest.mark.parametrize(
    ("words", "served"),
    [
        *(([HOST / "train.py"], True), (["-u", HOST / "train.py"], True)),
        ([HOST / "render.py", "-m", "out"], True),
        *((words, False) for words in (["-c", "print(1)"], ["-m", "tqdm"], ["nothere.py"], [])),
    ],
)
def test_scripts_of_hosts_are_served(words, served, tmp_path, monkeypatch):
    execv = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(started.os, "execv", execv)
    (tmp_path / OPTIONS).write_text("[]")
    (tmp_path / STOPPED).touch()  # what is served does not start any more
    words = [*map(str, words)]
    with pytest.raises(SystemExit if served else KeyboardInterrupt):
        started.main(tmp_path, words)
    if not served:
        execv.assert_called_once_with(sys.executable, [sys.executable, *words])


@pytest.mark.parametrize("beside", [True, False])
@pytest.mark.parametrize("script", [HOST / "render.py", "mine.py"])
def test_a_hosts_script_is_not_started_with_a_file_of_ours(script, beside, tmp_path, monkeypatch):
    """gsplat's benchmarks evaluate all of a folder of checkpoints. A folder may be named so."""
    execv = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(started.os, "execv", execv)
    (tmp_path / OPTIONS).write_text("[]")
    (tmp_path / STOPPED).touch()  # what is served does not start any more
    named = tmp_path / "ckpt_9_rank0.fragprune.safetensors"
    named.touch() if beside else named.mkdir()
    ends = SystemExit if script != "mine.py" else KeyboardInterrupt
    left_out = beside and script != "mine.py"
    with contextlib.nullcontext() if left_out else pytest.raises(ends):
        started.main(tmp_path, [str(script), "--ckpt", str(named)])
    assert len(sweep._runs(tmp_path)) == (script != "mine.py" and not left_out)


def test_a_training_that_fails_leaves_its_exit_code(tmp_path):
    (tmp_path / OPTIONS).write_text('["--device", "cpu"]')
    with pytest.raises(SystemExit) as ended:
        started.main(tmp_path, [str(HOST / "train.py"), "-s", "nothing"])
    (run,) = sweep._runs(tmp_path)
    assert run["exit_code"] == ended.value.code == 1
    assert sweep._line(run).endswith("train.py -s nothing\n  ended with exit code 1")


def test_a_training_that_nothing_serves_is_named_and_runs(tmp_path, monkeypatch):
    """Also at the end: what it prints may go to a file."""
    monkeypatch.setattr(started.os, "execv", lambda *_: sys.exit(0))
    script = script_of(tmp_path, "loss.backward()", "train_features.py")
    with pytest.raises(SystemExit):
        started.main(tmp_path, [str(script)])
    (run,) = sweep._runs(tmp_path)
    assert "train_features.py runs as it is, unpruned" in sweep._line(run)


def test_what_a_codebase_without_an_adapter_renders_is_not_pruned():
    report = {"adapter": None, "model_before": "point_cloud.ply", "model_after": "pruned.ply"}
    run = {"command": ["train.py"], "exit_code": 0, "report": report, "warnings": []}
    assert "draws point_cloud.ply, which is not pruned" in sweep._line(run)
