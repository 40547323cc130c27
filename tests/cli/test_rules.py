"""Options that exclude or need each other: what is given, and what is said."""

import click
import pytest
from click.testing import CliRunner

from fragprune_plugins.plugins.points import load, offered
from fragprune_plugins.workbench.commands import GROUP
from fragprune_plugins.workbench.commands.command import Command, Report
from fragprune_plugins.workbench.commands.rules import Alone, Needs

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
        ("--flag --number 3 here", "--flag with --number; expected one of them"),
        ("--word A.GIF --flag", "--word *.gif with --flag"),
        ("--number 3", "--number without --word far or THING; expected a far word or a thing"),
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
