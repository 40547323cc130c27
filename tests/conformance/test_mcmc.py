from __future__ import annotations

from miniatures.mcmc import MCMCHost

from fragprune_plugins.testing import AdapterConformance


class TestMCMC(AdapterConformance):
    adapter = "mcmc"
    host = MCMCHost
