"""A host's flags, of which we read a few: argparse, with our own words for what is wrong."""

from __future__ import annotations

import argparse
from typing import NoReturn

from fragprune_plugins.errors import UsageError


class Flags(argparse.ArgumentParser):
    """Says what is wrong with a flag as we say everything."""

    def error(self, message: str) -> NoReturn:
        """Raise UsageError; argparse would end the process."""
        raise UsageError(
            "the host's command", message, "flags the host understands", "Correct the command."
        )
