"""What commands make of their options: rules, defaults, words that are missing."""

import click
import pytest
from cli.commands import fails, run
from click.testing import CliRunner

from fragprune_plugins.plugins.points import load, offered
from fragprune_plugins.workbench.commands import GROUP, cli
from fragprune_plugins.workbench.commands.command import Command, Report
from fragprune_plugins.workbench.commands.learning import learning_options
from fragprune_plugins.workbench.commands.rules import Alone, Needs


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in cli.list_commands(None)
        if any(p.name in ("model", "a") for p in cli.get_command(None, name).params)
    ],
)
def test_a_model_that_is_not_there_is_what_is_wrong(name, tmp_path):
    out = tmp_path / "out"
    words = [] if name in ("bench", "compare", "profile", "view") else ["--out", out / "x.ply"]
    asked = (name, tmp_path / "no.ply", *([tmp_path / "b.ply"] * (name == "compare")), *words)
    fails(*asked, says=("[model-file]", "no.ply: no such file"), code=1)
    assert not out.exists()


def test_the_list_of_commands_cuts_no_sentence():
    assert "..." not in run("--help").stdout.split("Commands:")[1]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        *(("", "5000 3000 1"), ("--views 4", "1250 750 4"), ("--self", "1000 0 1")),
        *(("--views 4 --iters 900", "900 400 4"), ("--self --iters 9000", "9000 0 1")),
    ],
)
def test_steps_are_fewer_where_each_sees_more_views_or_no_photograph(options, said):
    @click.command()
    @click.option("--views", "views_per_step", default=1)
    @click.option("--self", "itself", is_flag=True)
    @learning_options(every_goal=True)
    def show(settings, **_):
        click.echo(f"{settings.iterations} {settings.warmup} {settings.views_per_step}")

    assert CliRunner().invoke(show, options.split()).stdout.strip() == said


RULES = (
    Alone(("--flag", "--number"), "one of them"),
    Alone(("--word *.gif", "--flag")),
    Needs("--number", ("--word far", "THING"), "a far word or a thing"),
)


@click.command("ruled", cls=Command, rules=RULES)
@click.argument("thing", required=False)
@click.option("--flag", is_flag=True)
@click.option("--number", default=3)
@click.option("--word", default="near")
def ruled(**_) -> Report:
    return Report({}, "done")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--flag", "done"),
        ("--number 3 here", "done"),
        ("--number 3 --word far", "done"),
        ("--word a.gif", "done"),
        ("--flag --number 3 here", "--flag with --number; expected one of them. Drop one of"),
        ("--word A.GIF --flag", "--word *.gif with --flag"),
        ("--number 3", "--number without --word far or THING; expected a far word or a thing. Add"),
    ],
)
def test_what_is_given_is_told_from_defaults(words, said):
    result = CliRunner().invoke(ruled, words.split())
    assert said in result.output
    assert result.exit_code == (0 if said == "done" else 2)


def test_every_rule_names_options_that_a_command_has():
    commands = [load(point, click.Command) for point in offered(GROUP).values()]
    known = {
        word
        for each in commands
        for param in each.params
        for word in (*param.opts, *param.secondary_opts, param.human_readable_name)
    }
    for command in commands:
        for rule in getattr(command, "rules", ()):
            names = rule.names if isinstance(rule, Alone) else (rule.name, *rule.others)
            assert {name.split(" ")[0] for name in names} <= known, command.name
