"""--log, --config and what a shell completes."""

import csv
import io
import logging
import sys
from importlib.metadata import EntryPoint
from types import SimpleNamespace

import pytest
from cli.commands import fails, run, run_json, succeeds
from click.shell_completion import ShellComplete

from fragprune_plugins.learning.events import StepStats
from fragprune_plugins.plugins.hookspecs import fragprune_step
from fragprune_plugins.plugins.loading import Plugins, installed
from fragprune_plugins.workbench.commands import cli, logs
from fragprune_plugins.workbench.commands.logs import (
    COLUMNS,
    Bar,
    CsvLog,
    TensorBoardLog,
    WandbLog,
    logging_steps,
)


def stats(step):
    return StepStats(step, 20.0 / step, 1e-4, 0.1, 0.5)


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def tell(plugins, steps):
    for step in steps:
        plugins.tell(fragprune_step, stats=stats(step))


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("step", "name"), [(2, "warm-up"), (3, "fine-tuning")])
def test_the_bar_of_a_run_says_when_it_warms_up(monkeypatch, step, name):
    monkeypatch.setattr(sys, "stderr", Terminal())
    bar = Bar(4, warmup=2)
    bar.write(stats(step))
    bar.close()
    assert f"fragprune, {name}: " in sys.stderr.getvalue()


def test_finetune_writes_a_row_a_step(words, tmp_path):
    log = tmp_path / "steps.csv"
    report = run_json(*words, 6, "--train", "opacity", "--log", f"csv:{log}")
    written = rows(log)
    assert [int(row["step"]) for row in written] == [1, 2, 3, 4, 5, 6]
    assert set(written[0]) == set(COLUMNS)
    assert float(written[-1]["fragments_per_pixel"]) > 0
    assert report["iterations"] == 6
    assert installed().answering(fragprune_step) == []  # nobody is left behind


@pytest.mark.parametrize(
    ("runs", "left", "told"),
    [
        ([(1, 2, 3), (1, 2)], [1, 2], "has rows of an earlier run: 0 stay, 3 go"),
        ([(1, 2), (3, 4)], [1, 2, 3, 4], "2 stay, 0 go"),  # it was killed, and goes on
        ([(1, 2, 3), (3, 4)], [1, 2, 3, 4], "2 stay, 1 go"),  # from a step before
        ([(7, 8), (7, 8, 9)], [7, 8, 9], "0 stay, 2 go"),  # learned within a training
    ],
)
def test_a_new_run_begins_the_file_anew_and_a_resumed_one_appends(
    tmp_path, caplog, runs, left, told
):
    log = tmp_path / "steps.csv"
    for steps in runs:
        plugins = Plugins()
        with logging_steps([CsvLog(str(log))], plugins):
            tell(plugins, steps)
            assert rows(log)[-1]["step"] == str(steps[-1])  # it can be followed while it grows
    assert [int(row["step"]) for row in rows(log)] == left
    (said,) = caplog.messages
    assert str(log) in said
    assert told in said


def test_tensorboard_has_every_curve(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    plugins = Plugins()
    with logging_steps([TensorBoardLog(str(tmp_path / "runs"))], plugins):
        tell(plugins, [1, 2, 4])
    events = EventAccumulator(str(tmp_path / "runs"))
    events.Reload()
    assert set(events.Tags()["scalars"]) == {f"fragprune/{name}" for name in COLUMNS[1:]}
    points = events.Scalars("fragprune/fragments_per_pixel")
    assert [(point.step, point.value) for point in points] == [(1, 20.0), (2, 10.0), (4, 5.0)]


def test_wandb_gets_every_step(monkeypatch):
    """The package is a stand-in: what we call of it, with which names."""
    seen = []
    begun = SimpleNamespace(
        log=lambda values, step: seen.append((step, values)), finish=lambda: seen.append("end")
    )
    stand_in = SimpleNamespace(init=lambda project: seen.append(project) or begun)
    monkeypatch.setitem(sys.modules, "wandb", stand_in)
    plugins = Plugins()
    with logging_steps([WandbLog("pruning")], plugins):
        tell(plugins, [1, 2])
    assert seen[0] == "pruning"
    assert [step for step, _ in seen[1:3]] == [1, 2]
    assert seen[1][1]["fragprune/fragments_per_pixel"] == 20.0
    assert seen[3] == "end"


def test_a_missing_library_is_a_usage_error_that_says_what_to_install(words, out, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    fails(*words, 6, "--log", "wandb:x", says="fragprune-plugins[wandb]")
    assert not out.exists()


def test_a_plugins_log_that_cannot_be_opened_is_named(words, out, monkeypatch):
    monkeypatch.setattr(logs, "offered", lambda _: {"mine": EntryPoint("mine", "array:array", "g")})
    fails(*words, 6, "--log", "mine:x", says="[plugin] g mine: ValueError", code=1)
    assert not out.exists()


def test_a_log_that_fails_later_does_not_stop_learning(words, caplog):
    with caplog.at_level(logging.WARNING):
        succeeds(*words, 6, "--train", "opacity", "--log", "csv:/dev/full")
    assert "log-0-CsvLog, fragprune_step: OSError" in caplog.text


def test_a_log_that_cannot_be_closed_costs_no_result(caplog):
    class Lines(CsvLog):
        def close(self):
            super().close()
            raise SystemExit(6)

    with logging_steps([Lines("/dev/null"), closed := CsvLog("/dev/null")], Plugins()):
        pass
    assert "Lines cannot be closed (SystemExit: 6)" in caplog.text
    assert closed._file.closed


def test_a_config_file_gives_the_options(data, path, tmp_path):
    """Also flags, and in a list what is given several times."""
    log, config = tmp_path / "a.csv", tmp_path / "quick.toml"
    config.write_text(
        f"data = '{data}'\niters = 4\ntrain = 'opacity'\nself = true\nlog = ['csv:{log}']\n"
    )
    words = ("finetune", path, "--config", config)
    report = run_json(*words, "--out", tmp_path / "a.ply")
    assert report["iterations"] == len(rows(log)) == 4
    assert report["settings"]["train"] == "opacity"
    assert report["target"] == "itself"
    other = run_json(*words, "--out", tmp_path / "b.ply", "--iters", 2)  # the line goes before
    assert other["iterations"] == 2


def test_a_shell_completes_commands():
    asked = ShellComplete(cli, {}, "fragprune", "_FRAGPRUNE_COMPLETE")
    assert [each.value for each in asked.get_completions([], "fine")] == ["finetune"]


def test_a_file_that_is_no_log_is_not_begun_anew(words, path):
    before = path.read_bytes()
    fails(*words, 6, "--log", f"csv:{path}", says="a file that is no log", code=1)
    assert path.read_bytes() == before


VALUES = {
    "unknown = 1": "'unknown' is no option of",
    "iters = 'x'": "not a valid integer",
    "iters": "not readable as TOML",
    "config = 'a.toml'": "'config' is no option of",
    "train = 'paper'": "is not one of",
    "iters = [1]": "where one value belongs",
    "iters = true": "where one value belongs",
    "iters = inf": "not a valid integer",
    "iters = 1" + 400 * "0": "expected 1 to 1,000,000,000",
    "iters = {a = 1}": "where text or a number belongs",
    "iters = 1979-05-27": "where text or a number belongs",
    "seed = 1e400": "not a valid integer",
    "portable = []": "where true or false belongs",
    "white-background = 3": "where true or false belongs",
    "log = 'csv:a.csv'": "where a list belongs",
    "log = [['csv:a.csv']]": "where text or a number belongs",
    'out = "\\u0000.ply"': "where text or a number belongs",
    "max-drop = nan": "nan is not a number in a range",
}


@pytest.mark.parametrize("text", VALUES)
def test_a_config_file_is_read_as_the_line_is_and_what_is_wrong_is_a_usage_error(tmp_path, text):
    (tmp_path / "a.toml").write_text(text)
    words = [] if "out" in text else ["--out", "b.ply"]
    result = run("finetune", __file__, *words, "--config", tmp_path / "a.toml")
    assert result.exit_code == 2
    assert VALUES[text] in " ".join(result.stderr.split())
