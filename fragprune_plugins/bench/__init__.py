"""Benchmarks: a reproducible scene, medians with their spread, ratios within one run."""
