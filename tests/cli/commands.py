"""Running a command in this process, and what every one of them promises."""

import json
from pathlib import Path

from click.testing import CliRunner, Result

from fragprune_plugins.workbench.commands import cli


def run(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(a) for a in arguments], catch_exceptions=False)


def succeeds(*arguments: object) -> Result:
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    return result


def run_json(command: str, *arguments: object) -> dict:
    """The one JSON object on stdout of a command that succeeds."""
    return json.loads(succeeds(command, "--json", *arguments).stdout)


def run_error(*arguments: object, code: int = 1) -> dict:
    """What a command that fails with this exit code states, as JSON on stdout."""
    result = run(*arguments)
    assert result.exit_code == code, result.output
    return json.loads(result.stdout)["error"]


def drawing(data: Path, path: Path, cameras: Path, out: Path) -> dict[str, tuple]:
    """Commands that draw a model, and what each needs."""
    return {
        "finetune": (path, "--data", data, "--out", out / "small.ply", "--iters", 2),
        "render": (path, "--data", data, "--out", out),
        "profile": (path, "--data", data, "--out", out),
        "compare": (path, path, "--data", data, "--out", out),
        "bench": (path, "--cameras", cameras, "--size", "32x32"),
    }


DRAWING = ("finetune", "render", "profile", "compare", "bench")


def fails(*arguments: object, says: str | tuple[str, ...], code: int = 2) -> None:
    """A command fails with this exit code, and says this on stderr."""
    result = run(*arguments)
    assert result.exit_code == code, result.output
    for each in (says,) if isinstance(says, str) else says:
        assert each in result.stderr
