"""Experiments: named comparisons of trainings, all measured alike.

``catalogue`` says what is compared and ``rules`` has thresholds that are not learned. ``running``
trains and measures; ``results`` makes the table and the plot.
"""
