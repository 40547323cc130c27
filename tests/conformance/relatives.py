"""Hosts that share their patches with vanilla 3DGS, or with another variant of themselves."""

from fragprune_plugins.testing import AdapterConformance


class RelativeConformance(AdapterConformance):
    """All invariants, in fewer orders of import: vanilla's test tries more and longer ones."""

    longest_order = 2
    examples = 6
