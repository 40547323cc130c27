from __future__ import annotations

from mcmc_host import MCMCHost

from fragprune_plugins.testing import AdapterConformance


class TestMCMC(AdapterConformance):
    adapter = "mcmc"
    host = MCMCHost
