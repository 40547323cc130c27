"""Model files: splats with their thresholds, in every format that holds them."""
