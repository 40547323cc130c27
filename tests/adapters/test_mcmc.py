"""3DGS-MCMC: relocation, addition and noise, on a miniature of the host."""

import json

from miniatures import runs
from miniatures.mcmc import MCMCHost
from miniatures.runs import OPTIONS, miniature

from fragprune_3dgs_fork import ForkAdapter
from fragprune_mcmc import MCMC
from fragprune_plugins.injection.launch import run
from fragprune_plugins.testing import invariants
from fragprune_plugins.testing.fresh import fresh

mini, of = miniature(MCMCHost, MCMC)


def test_a_fork_that_relocates_is_followed(tmp_path):
    MCMCHost().write(tmp_path)
    fresh(invariants.alignment, invariants.Case(ForkAdapter(), MCMCHost(), tmp_path, examples=4))


def command(mini, scene, out, iterations, *more):
    words = runs.command(mini / "train.py", scene, out, iterations, "--noise_lr", 5e7)
    return [*words, *map(str, more)]


def test_what_stage_two_changes_wins_over_the_configuration_file(mini, photographs, tmp_path):
    config, out = tmp_path / "scene.json", tmp_path / "out"
    values = {"cap_max": 170, "iterations": 12, "model_path": str(out), "noise_lr": 1.0}
    config.write_text(json.dumps(values))
    summary = run(command(mini, photographs, "elsewhere", 5, "--config", config), OPTIONS)
    assert summary.model_before == out / "point_cloud" / "iteration_12" / "point_cloud.ply"
    assert summary.model_after == out / "point_cloud" / "iteration_21" / "point_cloud.ply"
    assert 150 < summary.gaussians <= 170
    assert json.loads(config.read_text()) == values
