"""Rules give the thresholds that their names say, and a training follows them."""

from __future__ import annotations

import math

import pytest
import torch
from finetune import tiny
from hypothesis import given
from hypothesis import strategies as st
from lab.rules import Rule, alpha_cutoff, falloff_threshold, finetune_by

from fragprune_plugins.engines import create_engine
from fragprune_plugins.learning.goals import Control, Pressure
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.workbench.finetune.api import finetune

OPACITIES = st.lists(st.floats(1e-3, 0.999), min_size=1, max_size=20)


@given(OPACITIES, st.floats(1e-3, 0.999))
def test_a_falloff_threshold_is_the_same_for_all(opacities, tau):
    given = torch.tensor(opacities)
    assert falloff_threshold(tau).thresholds(given).tolist() == pytest.approx(
        [tau] * len(given), rel=1e-6
    )


@given(OPACITIES, st.integers(1, 64), st.floats(0.0, 6.0))
def test_an_alpha_cutoff_draws_what_is_as_opaque(opacities, levels, q):
    thresholds = alpha_cutoff(levels).thresholds(torch.tensor(opacities)).tolist()
    for opacity, threshold in zip(opacities, thresholds, strict=True):
        falloff = math.exp(-q / 2)
        alpha = opacity * falloff
        if abs(255 * alpha / levels - 1) > 1e-4 and falloff < 1:
            assert (falloff >= threshold) == (alpha >= levels / 255)


@pytest.fixture
def scene(tmp_path):
    truth = tiny.random_model()
    return tiny.perturbed(truth), tiny.dataset_in_memory(tmp_path, truth)


@pytest.mark.parametrize("rule", [falloff_threshold(0.2), alpha_cutoff(12)])
def test_a_training_follows_a_rule_as_opacities_move(scene, rule):
    model, dataset = scene
    settings = Settings(iterations=4, goal=Pressure(1e-2))
    result = finetune_by(rule, model, dataset, settings)
    opacities = result.model.splats().opacities
    assert not torch.equal(opacities, model.splats().opacities)
    torch.testing.assert_close(
        result.model.falloff, rule.thresholds(opacities), atol=2e-7, rtol=1e-5
    )
    assert result.progress.pressure == 0
    assert result.progress.speedup > 1.05


def test_a_rule_that_cuts_nothing_trains_as_the_control_does(scene):
    """Nothing presses on fragments."""
    model, dataset = scene
    settings = Settings(iterations=6, train="opacity", stop=None)
    ruled = finetune_by(falloff_threshold(1e-6), model, dataset, settings)
    control = finetune(model, dataset, Settings(iterations=6, train="opacity", goal=Control()))
    assert torch.equal(ruled.model.opacity, control.model.opacity)


def test_thresholds_of_a_rule_get_no_gradient(scene):
    model, dataset = scene
    engine, wanted = create_engine("auto"), []

    class Watched:
        name = "watched"

        def rasterize(self, inputs, thresholds):
            if thresholds is not None:
                wanted.append(thresholds.requires_grad)
            return engine.rasterize(inputs, thresholds)

    finetune_by(alpha_cutoff(8), model, dataset, Settings(iterations=3), engine=Watched())
    assert wanted == [False] * 3


def test_a_rule_waits_as_long_as_learned_thresholds_do(scene, monkeypatch):
    monkeypatch.setattr(Settings, "warmup", 3)
    model, dataset = scene
    drawn = []

    def watched(opacities):
        drawn.append(len(opacities))
        return falloff_threshold(0.2).thresholds(opacities)

    finetune_by(Rule("watched", watched), model, dataset, Settings(iterations=5))
    assert len(drawn) == 2 + 1  # two steps that truncate, and the finished model
