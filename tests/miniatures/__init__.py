"""Hosts small enough to test on, each the demo's host rewritten from the real one's interface.

A module a host, with the class that drives it in the conformance kit. ``skeletons`` has hosts with
signatures alone, for detection.
"""
