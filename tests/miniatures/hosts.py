"""Every miniature by the name of the adapter that fits it."""

from fragprune_plugins.testing import Host
from miniatures.changed import ForkHost
from miniatures.compact_3dgs import CompactHost
from miniatures.light_gaussian import LightGaussianHost
from miniatures.lp_3dgs import LPHost
from miniatures.mcmc import MCMCHost
from miniatures.mini_splatting import MiniSplattingHost
from miniatures.mip_splatting import MipHost
from miniatures.moving import MovingHost
from miniatures.rain_gs import RainHost
from miniatures.rt_4dgs import RT4DGSHost
from miniatures.speedy_splat import SpeedyHost
from miniatures.surfels import SurfelHost

HOSTS = {
    "2dgs": SurfelHost,
    "3dgs-fork": ForkHost,
    "4dgaussians": MovingHost,
    "compact-3dgs": CompactHost,
    "light-gaussian": LightGaussianHost,
    "lp-3dgs": LPHost,
    "mcmc": MCMCHost,
    "mini-splatting": MiniSplattingHost,
    "mip-splatting": MipHost,
    "rain-gs": RainHost,
    "rt-4dgs": RT4DGSHost,
    "speedy-splat": SpeedyHost,
    "vanilla-3dgs": Host,
}
