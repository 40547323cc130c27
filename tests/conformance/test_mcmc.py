from __future__ import annotations

from conformance.relatives import RelativeConformance
from miniatures.mcmc import MCMCHost


class TestMCMC(RelativeConformance):
    adapter = "mcmc"
    host = MCMCHost
