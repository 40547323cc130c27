"""When a host's densification is over, read from its own arguments: joint learning begins then."""

import pytest
from miniatures.hosts import HOSTS
from miniatures.runs import command, written

from fragprune_plugins.adapting import HostRepo, UsageError
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.testing.conformance import found_adapter

UNTIL = ("--densify_until_iter", "700")
SIMPLIFIED = ("--simp_iteration1", "700", "--simp_iteration2", "720")


@pytest.mark.parametrize(
    ("name", "words", "end"),
    [
        ("vanilla-3dgs", [], 15_000),
        ("vanilla-3dgs", [*UNTIL], 700),
        ("vanilla-3dgs", [*UNTIL, "--densify_until_iter=900"], 900),
        ("mcmc", [*UNTIL], 700),
        ("mip-splatting", [*UNTIL], 700),
        ("rain-gs", [*UNTIL], 700),
        ("rain-gs", [*UNTIL, "--warmup_iter", "50"], 750),
        ("rain-gs", [*UNTIL, "--ours_new"], 10_700),
        ("rt-4dgs", [*UNTIL], 700),
        ("4dgaussians", [*UNTIL], 700),
        ("light-gaussian", [*UNTIL], 16_000),
        ("light-gaussian", [*UNTIL, "--prune_iterations", "80", "90"], 700),
        ("light-gaussian", [*UNTIL, "--prune_iterations", "80", "990"], 990),
        ("speedy-splat", [*UNTIL], 30_000),
        ("speedy-splat", [*UNTIL, "--prune_until_iter", "0"], 700),
        ("lp-3dgs", [*UNTIL], 700),
        ("light-gaussian/prune_finetune.py", [*UNTIL], None),  # it goes on from a checkpoint
        ("mini-splatting/gs/train.py", [*UNTIL, *SIMPLIFIED], 700),
        ("mini-splatting/ms/train.py", [*UNTIL, *SIMPLIFIED], 720),
        ("compact-3dgs", [*UNTIL], None),
    ],
)
def test_the_end_of_densification_is_read_from_the_hosts_own_arguments(name, words, end, tmp_path):
    name, _, script = name.partition("/")
    adapter, root = found_adapter(name), written(HOSTS[name], tmp_path)
    assert adapter.densified(HostRepo(root), root / (script or adapter.scripts[0]), words) == end


def test_a_configuration_file_overrides_the_flag_as_it_does_in_the_host(tmp_path):
    root, file = written(HOSTS["mcmc"], tmp_path / "host"), tmp_path / "a.json"
    file.write_text('{"densify_until_iter": 400}')
    words = [*UNTIL, "--config", str(file)]
    assert found_adapter("mcmc").densified(HostRepo(root), root / "train.py", words) == 400


@pytest.mark.parametrize(
    ("name", "last", "says"),
    [
        ("vanilla-3dgs", 18, r"after 18, where densification ends.*or lower --from-iter"),
        ("compact-3dgs", 24, r"does not tell when.*Add --from-iter"),
    ],
)
def test_where_joint_learning_cannot_begin_is_refused(name, last, says, photographs, tmp_path):
    script = written(HOSTS[name], tmp_path / "host") / "train.py"
    with pytest.raises(UsageError, match=says):
        run(
            command(script, photographs, tmp_path / "out", last),
            RunOptions(stage="joint", device="cpu"),
        )
    assert not (tmp_path / "out").exists()
