from conformance.relatives import RelativeConformance
from installed.gaussian_splatting_host import GaussianSplattingHost, MCMCHost

from fragprune_plugins.testing import AdapterConformance


class TestGaussianSplatting(AdapterConformance):
    adapter = "gaussian-splatting"
    host = GaussianSplattingHost


class TestGaussianSplattingMCMC(RelativeConformance):
    adapter = "gaussian-splatting"
    host = MCMCHost
