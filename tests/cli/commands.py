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


def finetune_words(scene: tuple, out: object, *more: object) -> tuple:
    """A short fine-tuning of a model on its photographs."""
    data, path = scene
    return ("finetune", path, "--data", data, "--out", out, "--iters", 20, *more)
