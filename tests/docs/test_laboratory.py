"""docs/experiments/lab: its commands, which use ours, can be run from a checkout."""

import subprocess
import sys
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).parents[2] / "docs" / "experiments"


@pytest.mark.parametrize("experiment", ["rules", "stages"])
def test_an_experiment_says_what_it_takes(experiment):
    words = [sys.executable, "-m", "lab", experiment, "--help"]
    asked = subprocess.run(words, cwd=EXPERIMENTS, capture_output=True, text=True)
    assert (asked.returncode, asked.stderr) == (0, "")
    assert "--data" in asked.stdout
