"""Reads a few of a host's flags: argparse with our own error messages."""

from __future__ import annotations

import argparse
from typing import NoReturn

from fragprune_plugins.errors import UsageError


class Flags(argparse.ArgumentParser):
    """An argument parser that raises our errors."""

    def error(self, message: str) -> NoReturn:
        """Raise UsageError; argparse would end the process."""
        raise UsageError(
            "the host's command", message, "flags the host understands", "Correct the command."
        )
