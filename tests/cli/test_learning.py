"""``run`` and ``finetune`` understand the options of learning alike."""

from itertools import combinations

import click
import pytest
from cli.commands import fails, run
from click.testing import CliRunner

from fragprune_plugins.workbench.commands.learning import learning_options

HOST = ("--", "train.py")
COMMANDS = {"run": HOST, "finetune": (__file__, "--data", "scene", "--out", "out.ply")}


GOALS = {
    "--control": (),
    "--portable": (),
    "--pressure": (1e-4,),
    "--target-speedup": (2,),
    "--target-time": (2,),
    "--max-drop": (0.1,),
}


@pytest.mark.parametrize(
    ("one", "other"), [p for p in combinations(GOALS, 2) if p != ("--portable", "--pressure")]
)
def test_two_goals_are_usage(one, other):
    words = (other, *GOALS[other], one, *GOALS[one])
    fails("finetune", *words, *COMMANDS["finetune"], says=f"{one} with {other}; expected one goal")


@pytest.mark.parametrize("command", COMMANDS)
def test_both_take_their_goal_and_length_alike(command):
    for words in (("--quick", "--iters", 10), ("--control", "--target-speedup", 2)):
        fails(command, *words, *COMMANDS[command], says=f"{words[0]} with {words[1]}")


@pytest.mark.parametrize(
    "options",
    [
        *(("--iters", 0), ("--pressure", 5), ("--target-speedup", 1), ("--target-time", 21)),
        *(("--stop", 3), ("--max-drop", -1), ("--max-drop", 11), ("--max-drop", "much")),
        *(("--keep", share) for share in ("0", "1.5", "x", "nan")),
    ],
)
def test_values_out_of_range_are_usage(options):
    result = run("finetune", *options, *COMMANDS["finetune"])
    assert result.exit_code == 2
    assert "[usage]" in result.stderr or "Invalid value" in result.stderr
    assert options[0] in result.stderr


@pytest.mark.parametrize(
    ("options", "iterations", "warmup"),
    [
        *(((), 5000, 3000), (("--views", 4), 1250, 750), (("--self",), 1000, 0)),
        (("--views", 4, "--iters", 900), 900, 400),
    ],
)
def test_steps_are_fewer_where_each_sees_more_views_or_no_photograph(options, iterations, warmup):
    @click.command()
    @click.option("--views", "views_per_step", default=1)
    @click.option("--self", "itself", is_flag=True)
    @learning_options(every_goal=True)
    def show(settings, **_):
        click.echo(f"{settings.iterations} {settings.warmup} {settings.views_per_step}")

    views = options[1] if "--views" in options else 1
    said = CliRunner().invoke(show, list(map(str, options))).stdout.split()
    assert said == [str(iterations), str(warmup), str(views)]


def test_a_log_of_several_trainings_is_refused_before_it_is_begun(tmp_path):
    place = tmp_path / "steps.csv"
    words = ("--max-drop", 0.1, "--log", f"csv:{place}")
    asked = ("finetune", __file__, "--data", tmp_path, "--out", "out.ply", *words)
    fails(*asked, says="--log with --max-drop")
    assert not place.exists()
