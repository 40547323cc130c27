"""Plugins: their hooks, how they are found, and our own answers."""
