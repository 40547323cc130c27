"""Thresholds injected into a running host: its functions wrapped, its training followed.

launch       runs a host's command        command      what its flags mean
starting     what stage 2 goes on from    process      what its script finds around itself
cpu_only     runs a CUDA host without CUDA
api          one line in a fork instead
session      one host in one process: each call goes to the handler of its role
stepping     steps and optimizers         rasterizing  views, rasterizations, the pressure
aligning     rows that come and go        saving       sidecars and checkpoints
state        what all handlers share: the run, its models
patching     wraps functions and restores them
stand_ins    take the place of compiled packages
"""
