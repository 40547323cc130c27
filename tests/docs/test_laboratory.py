"""docs/experiments/lab: its commands, which use ours, can be run from a checkout."""

import pytest
from click.testing import CliRunner
from lab.command import command


@pytest.mark.parametrize("experiment", ["rules", "stages"])
def test_an_experiment_says_what_it_takes(experiment):
    asked = CliRunner().invoke(command, [experiment, "--help"], catch_exceptions=False)
    assert asked.exit_code == 0
    assert "--data" in asked.stdout
