"""Running a command in this process, and what every one of them promises."""

import json

from click.testing import CliRunner, Result

from fragprune_plugins.workbench.commands import cli


def run(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(a) for a in arguments], catch_exceptions=False)


def run_json(*arguments: object) -> dict:
    """The one JSON object on stdout of a command that succeeds."""
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)
