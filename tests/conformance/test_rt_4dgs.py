from conformance.relatives import RelativeConformance
from miniatures.rt_4dgs import PythonHost, RigidHost, RT4DGSHost


class TestRT4DGS(RelativeConformance):
    adapter = "rt-4dgs"
    host = RT4DGSHost


class TestRT4DGSWithout4DRotation(RelativeConformance):
    adapter = "rt-4dgs"
    host = RigidHost
    examples = 5
    longest_order = 1


class TestRT4DGSSlicedInPython(RelativeConformance):
    adapter = "rt-4dgs"
    host = PythonHost
    examples = 5
    longest_order = 1
