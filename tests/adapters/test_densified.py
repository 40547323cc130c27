"""When a host's densification is over, read from its own arguments: joint learning begins then."""

import pytest
from miniatures.compact_3dgs import CompactHost
from miniatures.light_gaussian import LightGaussianHost
from miniatures.lp_3dgs import LPHost
from miniatures.mcmc import MCMCHost
from miniatures.mini_splatting import MiniSplattingHost
from miniatures.mip_splatting import MipHost
from miniatures.moving import MovingHost
from miniatures.rain_gs import RainHost
from miniatures.rt_4dgs import RT4DGSHost
from miniatures.runs import command, written
from miniatures.speedy_splat import SpeedyHost
from miniatures.vanilla_3dgs import HOST

from fragprune_4dgaussians import MovingGaussians
from fragprune_compact_3dgs import Compact3DGS
from fragprune_light_gaussian import LightGaussian
from fragprune_lp_3dgs import LP3DGS
from fragprune_mcmc import MCMC
from fragprune_mini_splatting import MiniSplatting
from fragprune_mip_splatting import MipSplatting
from fragprune_plugins.errors import UsageError
from fragprune_plugins.files import sidecar
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_rain_gs import RainGS
from fragprune_rt_4dgs import RT4DGS
from fragprune_speedy_splat import SpeedySplat
from fragprune_vanilla_3dgs import Vanilla3DGS

UNTIL = ("--densify_until_iter", "700")


@pytest.mark.parametrize(
    ("adapter", "host", "words", "end"),
    [
        (Vanilla3DGS, None, [], 15_000),
        (Vanilla3DGS, None, [*UNTIL], 700),
        (Vanilla3DGS, None, [*UNTIL, "--densify_until_iter=900"], 900),
        (MCMC, MCMCHost, [*UNTIL], 700),
        (MipSplatting, MipHost, [*UNTIL], 700),
        (RainGS, RainHost, [*UNTIL], 700),
        (RainGS, RainHost, [*UNTIL, "--warmup_iter", "50"], 750),
        (RainGS, RainHost, [*UNTIL, "--ours_new"], 10_700),
        (RT4DGS, RT4DGSHost, [*UNTIL], 700),
        (MovingGaussians, MovingHost, [*UNTIL], 700),
        (LightGaussian, LightGaussianHost, [*UNTIL], 16_000),
        (LightGaussian, LightGaussianHost, [*UNTIL, "--prune_iterations", "80", "90"], 700),
        (LightGaussian, LightGaussianHost, [*UNTIL, "--prune_iterations", "80", "990"], 990),
        (SpeedySplat, SpeedyHost, [*UNTIL], 30_000),
        (SpeedySplat, SpeedyHost, [*UNTIL, "--prune_until_iter", "0"], 700),
        (LP3DGS, LPHost, [*UNTIL], 700),
        (Compact3DGS, CompactHost, [*UNTIL], None),
    ],
)
def test_the_end_of_densification_is_read_from_the_hosts_own_arguments(
    adapter, host, words, end, tmp_path
):
    root = written(host, tmp_path) if host else HOST
    script = root / adapter.scripts[0]
    assert adapter().densified(HostRepo(root), script, words) == end


def test_mini_splatting_ends_with_its_last_simplification(tmp_path):
    repo = HostRepo(written(MiniSplattingHost, tmp_path))
    words = [*UNTIL, "--simp_iteration1", "700", "--simp_iteration2", "720"]
    ends = {
        variant: MiniSplatting().densified(repo, repo.root / variant / "train.py", words)
        for variant in ("gs", "ms")
    }
    assert ends == {"gs": 700, "ms": 720}


def test_what_follows_a_checkpoint_has_no_densification_to_wait_for(tmp_path):
    root = written(LightGaussianHost, tmp_path)
    script = root / "prune_finetune.py"
    assert LightGaussian().densified(HostRepo(root), script, [*UNTIL]) is None


def test_a_configuration_file_overrides_the_flag_as_it_does_in_the_host(tmp_path):
    root, file = written(MCMCHost, tmp_path / "host"), tmp_path / "a.json"
    file.write_text('{"densify_until_iter": 400}')
    words = [*UNTIL, "--config", str(file)]
    assert MCMC().densified(HostRepo(root), root / "train.py", words) == 400


def test_joint_learning_begins_when_densification_is_over(photographs, tmp_path):
    words = command(HOST / "train.py", photographs, tmp_path / "out", 24)
    summary = run(words, RunOptions(stage="joint", device="cpu"))
    assert [row["step"] for row in summary.curves] == [19, 20, 21, 22, 23]  # flags say 18
    assert sidecar.load(summary.model_after)[0].steps == 5


def test_a_training_that_densifies_to_its_end_is_refused(photographs, tmp_path):
    words = command(HOST / "train.py", photographs, tmp_path / "out", 18)
    with pytest.raises(
        UsageError, match=r"iterations after 18, where densification ends.*or lower --from-iter"
    ):
        run(words, RunOptions(stage="joint", device="cpu"))
    assert not (tmp_path / "out").exists()


def test_a_host_that_does_not_tell_is_asked_for_the_iteration(photographs, tmp_path):
    root = written(CompactHost, tmp_path / "host")
    words = command(root / "train.py", photographs, tmp_path / "out", 24)
    with pytest.raises(UsageError, match=r"does not tell when.*Add --from-iter"):
        run(words, RunOptions(stage="joint", device="cpu"))
