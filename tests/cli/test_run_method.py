"""fragprune run, where stage 2 is a method of the host itself."""

import sys
from functools import partial
from pathlib import Path

import pytest
from cli import commands

from fragprune_nerfstudio import running
from fragprune_plugins.adapting import Finding, HostAdapter, HostInfo
from fragprune_plugins.errors import HostFailed, UsageError
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.learning.schedule import Settings

PACKAGE = "a_studio_of_the_tests"
RUN = ("run", "--device", "cpu", "--iters", 3)
THEIRS = ("--", "python", "-m", f"{PACKAGE}.train", "theirs")
TRAIN = """
import sys
from fragprune_plugins import errors
from fragprune_plugins.learning.events import StepStats, Summary
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.loading import installed

method, iterations, *rest = sys.argv[1:]
for stated in (errors.Interrupted, errors.Terminated):
    if stated.__name__ in rest:
        raise SystemExit(99) from stated("studio", "a signal", "none", "Go on.")
assert method == "theirs-with-stage-two", method
if "stops" not in rest:
    for step in range(int(iterations)):
        stats = StepStats(step + 1, 9.0, 1e-3, 0.1)
        installed().tell(hookspecs.fragprune_step, stats=stats)
    settings = {"goal": "control" if "control" in rest else "pressure"}
    learned = {"gaussians": 7, "fragments_before": 9.0, "fragments_after": 3.0}
    made = {"adapter": "studio", "engine": "cpu", "steps": int(iterations), "settings": settings}
    summary = Summary(**made, **learned)
    installed().tell(hookspecs.fragprune_finished, summary=summary)
"""


class Studio(HostAdapter):
    name = "studio"
    info = HostInfo("Studio", repo="me/studio")
    seams = ()
    installed = (PACKAGE,)

    def fingerprint(self, repo):
        ours = repo.package == PACKAGE
        return [] if ours else [Finding("error", "other-host", str(repo.root), "a folder")]

    def trainer(self, repo, script):
        return partial(running.run, self.name, repo, self.rewritten, "the host's own evaluation")

    def rewritten(self, arguments, settings, *, stage, from_iter, engine, device):
        if stage == "joint":
            raise UsageError("--stage", stage, "auto", "Drop it.")
        control = () if settings.goal.presses else ("control",)
        first, *rest = arguments
        return [f"{first}-with-stage-two", str(settings.iterations), *control, *rest]

    def dialect(self, repo):
        raise NotImplementedError

    means = opacities = dialect


@pytest.fixture(autouse=True)
def _studio(tmp_path, monkeypatch, plug):
    folder = tmp_path / PACKAGE
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "train.py").write_text(TRAIN)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(Path(__file__).parent)
    plug(Studio, "studio")
    yield
    for name in [name for name in sys.modules if name.split(".")[0] == PACKAGE]:
        del sys.modules[name]


def ran(*words, **options):
    options = RunOptions(device="cpu", settings=Settings(iterations=3), **options)
    return run([*THEIRS[1:], *words], options)


def test_the_method_runs_in_place_of_the_named_one_and_its_summary_is_the_runs():
    summary = ran()
    assert (summary.adapter, summary.engine, summary.device) == ("studio", "cpu", "cpu")
    assert (summary.steps, summary.gaussians) == (3, 7)
    assert (summary.fragments_before, summary.fragments_after) == (9.0, 3.0)
    assert [curve["step"] for curve in summary.curves] == [1, 2, 3]
    assert "own evaluation" in summary.not_compared.remedy


def test_a_method_that_ends_before_stage_two_did_not_do_what_was_asked():
    with pytest.raises(HostFailed, match="before the end of stage 2"):
        ran("stops")


def test_a_control_is_called_one():
    done = commands.run(*RUN, "--control", *THEIRS)
    assert "3 iterations of the control" in done.stdout


@pytest.mark.parametrize(("how", "code"), [("Interrupted", 130), ("Terminated", 143)])
def test_a_method_that_was_interrupted_says_so(how, code):
    done = commands.run(*RUN, *THEIRS, how)
    assert done.exit_code == code
    assert "Go on." in done.stderr


def test_what_the_method_cannot_do_is_refused_before_the_host_runs():
    with pytest.raises(UsageError, match="Drop it"):
        ran(stage="joint")
