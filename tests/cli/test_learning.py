"""``run`` and ``finetune`` understand the options of learning alike."""

import pytest
from cli.commands import run

HOST = ("--", "train.py")
COMMANDS = {"run": HOST, "finetune": ("model.ply", "--data", "scene", "--out", "out.ply")}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    "options",
    [
        ("--quick", "--iters", 10),
        ("--pressure", 1e-4, "--target-speedup", 2),
        ("--control", "--pressure", 1e-4),
        ("--control", "--target-speedup", 2),
    ],
)
def test_contradictions_are_usage(command, options):
    result = run(command, *options, *COMMANDS[command])
    assert result.exit_code == 2
    assert f"{options[0]} with" in result.stderr


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("options", [("--iters", 0), ("--pressure", 5), ("--target-speedup", 1)])
def test_values_out_of_range_are_usage(command, options):
    result = run(command, *options, *COMMANDS[command])
    assert result.exit_code == 2
    assert "[usage]" in result.stderr
    assert options[0] in result.stderr
