from conformance.relatives import RelativeConformance
from miniatures.mini_splatting import MiniSplattingHost


class TestMiniSplatting(RelativeConformance):
    adapter = "mini-splatting"
    host = MiniSplattingHost
