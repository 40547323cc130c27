"""Benchmarks: a scene everybody can make again, medians with spread, ratios in one run."""
