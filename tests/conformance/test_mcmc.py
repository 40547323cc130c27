from conformance.relatives import RelativeConformance
from miniatures.mcmc import MCMCHost


class TestMCMC(RelativeConformance):
    adapter = "mcmc"
    host = MCMCHost
