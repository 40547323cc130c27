from fragprune_plugins.testing import AdapterConformance


class TestVanilla3DGS(AdapterConformance):
    adapter = "vanilla-3dgs"
