"""What all descendants of the 2023 3DGS training code share."""

from fragprune_plugins.hosts.graphdeco.adapter import GraphdecoAdapter, GraphdecoDialect
from fragprune_plugins.hosts.graphdeco.call import RasterizerCall

__all__ = ["GraphdecoAdapter", "GraphdecoDialect", "RasterizerCall"]
