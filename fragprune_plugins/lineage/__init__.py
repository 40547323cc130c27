"""What all descendants of the 2023 3DGS training code share."""

from fragprune_plugins.lineage.contract import Contract
from fragprune_plugins.lineage.graphdeco import GraphdecoAdapter, GraphdecoDialect

__all__ = ["Contract", "GraphdecoAdapter", "GraphdecoDialect"]
