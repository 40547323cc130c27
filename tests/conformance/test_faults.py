"""What one host alone can show of its adapter is found on that host."""

from contextlib import contextmanager

import pytest
import torch
from installed.gaussian_splatting_host import GaussianSplattingHost
from installed.gsplat_host import GsplatHost
from miniatures.compact_3dgs import CompactHost
from miniatures.light_gaussian import LightGaussianHost
from miniatures.mcmc import MCMCHost

import fragprune_gsplat
from fragprune_compact_3dgs import Compact3DGS
from fragprune_gaussian_splatting import GaussianSplatting
from fragprune_gsplat import ROWS, Gsplat
from fragprune_light_gaussian import LightGaussian
from fragprune_mcmc import MCMC
from fragprune_plugins.adapting import HostRepo, Role, RowTrace, revised
from fragprune_plugins.testing import invariants
from fragprune_plugins.testing.fresh import FreshProcessError, fresh


def but(kind, attribute):
    """An adapter's seams without those at an attribute."""
    return revised(kind.seams, {attribute: None})


def tracing(kind, how):
    """An adapter's seams with rows followed in another way."""
    seams = (seam.attribute for seam in kind.seams if seam.role is Role.REARRANGE)
    return revised(kind.seams, {attribute: {"how": how} for attribute in seams})


class Shaking(MCMC):
    """Leaves the host the rate that its noise is made of."""

    seams = revised(MCMC.seams, {"GaussianModel.update_learning_rate": {"how": None}})


class Growing(MCMC):
    """Lets the host add Gaussians."""

    seams = but(MCMC, "GaussianModel.add_new_gs")


class Unchosen(MCMC):
    """Does not know which rows a relocation copies."""

    seams = but(MCMC, "GaussianModel.relocate_gs")


class Pruning(LightGaussian):
    """Lets the host prune."""

    seams = but(LightGaussian, "GaussianModel.prune_gaussians")


class Unsorted(Compact3DGS):
    """Takes no notice of the last sort."""

    seams = but(Compact3DGS, "GaussianModel.sort_morton")


class Resetting(Gsplat):
    """Lets opacities be reset."""

    seams = but(Gsplat, "reset_opa")


@contextmanager
def inherited(call):
    with fragprune_gsplat.tracing(call) as trace:
        yield trace
    trace.fresh = torch.zeros_like(trace.fresh)


class Inheriting(Gsplat):
    """Gives children their parents' moments."""

    seams = tracing(Gsplat, inherited)


@contextmanager
def littered(call):
    with fragprune_gsplat.tracing(call) as trace:
        yield trace
    rows = torch.zeros(len(call.model["means"]))
    call.model[ROWS] = torch.nn.Parameter(rows, requires_grad=False)


class Littering(Gsplat):
    """Leaves its row numbers in the user's model."""

    seams = tracing(Gsplat, littered)


class Unexported(Gsplat):
    """Writes no thresholds beside what is exported."""

    seams = but(Gsplat, "export_splats")


class Skipping(GaussianSplatting):
    """Holds back the step in which opacities would be reset."""

    seams = revised(GaussianSplatting.seams, {"OpacityResetter.optim_step": {"how": None}})


@contextmanager
def untraced(call):
    yield RowTrace()


class Untraced(GaussianSplatting):
    """Thinks that densifiers leave rows where they were."""

    seams = tracing(GaussianSplatting, untraced)


class Misread(GaussianSplatting):
    """Takes any call of the rasterizer for the one it answers."""

    def fingerprint(self, repo):
        return []


@pytest.mark.parametrize(
    ("check", "adapter", "host", "words"),
    [
        (invariants.freeze, Shaking, MCMCHost, "moved ['opacity', 'xyz']"),
        (invariants.freeze, Growing, MCMCHost, "add made "),
        (invariants.alignment, Unchosen, MCMCHost, "descends from"),
        (invariants.freeze, Pruning, LightGaussianHost, "prune by score made "),
        (invariants.alignment, Unsorted, CompactHost, "descends from"),
        (invariants.freeze, Resetting, GsplatHost, "reset opacity changed opacities"),
        (invariants.alignment, Inheriting, GsplatHost, "two rows have the moments of one"),
        (invariants.neutral_is_the_host, Littering, GsplatHost, "became"),
        (invariants.model_file, Unexported, GsplatHost, "no sidecar was written"),
        (invariants.freeze, Skipping, GaussianSplattingHost, "0 threshold steps of 4"),
        (invariants.alignment, Untraced, GaussianSplattingHost, "one per threshold"),
        (invariants.refuse, Misread, GaussianSplattingHost, "takes one value more"),
    ],
    ids=lambda value: getattr(value, "__name__", "words"),
)
def test_a_fault_is_found_on_the_host_that_shows_it(check, adapter, host, words, tmp_path):
    driver, root = host(), tmp_path
    if driver.package:
        installed = HostRepo.installed(driver.package)
        if installed is None:
            pytest.skip(f"{driver.package} is not installed")
        root = installed.root
    else:
        driver.write(root)
    with pytest.raises(FreshProcessError) as caught:
        fresh(check, invariants.Case(adapter(), driver, root, examples=1))
    assert words in str(caught.value)
