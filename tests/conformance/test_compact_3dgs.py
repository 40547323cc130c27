from conformance.relatives import RelativeConformance
from miniatures.compact_3dgs import CompactHost


class TestCompact3DGS(RelativeConformance):
    adapter = "compact-3dgs"
    host = CompactHost
