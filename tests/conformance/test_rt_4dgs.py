from __future__ import annotations

from miniatures.rt_4dgs import PythonHost, RigidHost, RT4DGSHost

from fragprune_plugins.testing import AdapterConformance


class TestRT4DGS(AdapterConformance):
    adapter = "rt-4dgs"
    host = RT4DGSHost


class TestRT4DGSWithout4DRotation(AdapterConformance):
    adapter = "rt-4dgs"
    host = RigidHost
    examples = 5
    longest_order = 1


class TestRT4DGSSlicedInPython(AdapterConformance):
    adapter = "rt-4dgs"
    host = PythonHost
    examples = 5
    longest_order = 1
