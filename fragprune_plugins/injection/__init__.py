"""Thresholds injected into a running host: its functions wrapped, its training followed.

session      one host in one process: its seams, its models, what all handlers share
stepping     steps and optimizers         rasterizing  views, rasterizations, the pressure
aligning     rows that come and go        saving       sidecars and checkpoints
patching     wraps functions and restores them
launch       runs a host's command        cpu_only     runs a CUDA host without CUDA
"""
