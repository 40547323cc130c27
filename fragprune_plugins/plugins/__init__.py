"""Plugins: the hooks they may answer, how they are found, and our own answers."""
