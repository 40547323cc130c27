from conformance.relatives import RelativeConformance
from miniatures.mip_splatting import MipHost


class TestMipSplatting(RelativeConformance):
    adapter = "mip-splatting"
    host = MipHost
