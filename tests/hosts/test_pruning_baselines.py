"""The real Speedy-Splat and LP-3DGS, unmodified, where ``FRAGPRUNE_HOSTS`` points at them."""

from importlib.util import find_spec

import pytest
from hosts.test_checkouts import RUN, each_of

from fragprune_lp_3dgs import LP3DGS
from fragprune_speedy_splat import SpeedySplat

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

every_speedy = each_of(SpeedySplat())
every_lp = each_of(LP3DGS())
draws = pytest.mark.skipif(
    find_spec("torchvision") is None, reason="the host imports torchvision.transforms"
)


def expect_opacities_moved_alone(report):
    assert report["moved"] == ["opacity"]
    assert len(set(report["rows"])) == 1
    assert report["steps"] == [10, 10]
    assert not report["neutral"]
    before, after = report["fragments"]
    assert after < before


@every_speedy
@draws
def test_speedy_trains_then_fine_tunes(host, dataset, tmp_path, python):
    report = python(RUN, host, dataset, tmp_path / "out", "opacity", "--port", "0")
    expect_opacities_moved_alone(report)


@every_speedy
@draws
def test_speedys_own_pruning_is_refused_before_anything_is_lost(host, dataset, tmp_path, python):
    """In both of its forms: while it densifies, and afterwards."""
    for begin in ("10", "27"):
        prune = ["--prune_from_iter", begin, "--prune_interval", begin]
        with pytest.raises(AssertionError, match="--prune_until_iter 0"):
            python(RUN, host, dataset, tmp_path / begin, "opacity", "--port", "0", *prune)
        assert not list((tmp_path / begin).glob("point_cloud/*"))


TRAINED = """
    from contextlib import suppress
    from fragprune_plugins.errors import HostFailed
    train = [*words, "--checkpoint_iterations", "30"]
    with suppress(HostFailed):  # the host looks for iteration 30,000 when it has saved everything
        run(train, replace(options, stage="off"))
"""
ENDS_IN_AN_ERROR = RUN.replace(
    "    summary = run(words, replace(options))",
    TRAINED + "    summary = run(words, replace(options, stage='finetune'))",
)
"""Stage 2 on its own, from the checkpoint of a training that ends in the host's own KeyError."""


@every_lp
@draws
@pytest.mark.parametrize("method", ["3dgs", "mini_splatting", "rad_splat"])
def test_lp_fine_tunes_what_its_training_saved(host, dataset, tmp_path, python, method):
    words = ["--port", "0", "--prune_method", method]
    report = python(ENDS_IN_AN_ERROR, host, dataset, tmp_path / "out", "opacity", *words)
    expect_opacities_moved_alone(report)


# A mask begins at iteration 19,500 and its scores are computed at 19,520.
MASKED = ENDS_IN_AN_ERROR.replace(
    TRAINED,
    TRAINED
    + """
    capture, _ = torch.load(out / "chkpnt30.pth", weights_only=False)
    torch.save((capture, 19_490), out / "chkpnt19490.pth")
    again = ["--start_checkpoint", str(out / "chkpnt19490.pth"), "--use_importance_mask"]
    again += "--train_mask_iters 30 --iterations 19540 --checkpoint_iterations 19540".split()
    with suppress(HostFailed):
        run([*words, *again], replace(options, stage="off"))
""",
).replace("report = {", 'report = {"trained": len(capture[1]),')


@every_lp
@draws
def test_lp_learns_its_mask_from_blending_weights_of_ours(host, dataset, tmp_path, python):
    words = ["--port", "0", "--prune_method", "mini_splatting"]
    report = python(MASKED, host, dataset, tmp_path / "out", "opacity", *words)
    expect_opacities_moved_alone(report)
    assert 0 < report["rows"][0] < report["trained"]
