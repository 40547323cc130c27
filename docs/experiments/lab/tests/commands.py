"""Running an experiment in this process."""

from __future__ import annotations

import json

from click.testing import CliRunner, Result
from lab.command import command


def run(*arguments: object) -> Result:
    return CliRunner().invoke(command, [str(each) for each in arguments], catch_exceptions=False)


def run_json(*arguments: object) -> dict:
    """The one JSON object on stdout of an experiment that succeeds."""
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)
