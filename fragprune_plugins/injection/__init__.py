"""Injects thresholds into a running host: wraps its functions and follows its training.

launch       runs a host's command        command      reads and adds the host's flags
starting     finds the start of stage 2   process      sets up the process for the script
cpu_only     runs a CUDA host without CUDA
api          activates fragprune inside a fork, by one line
session      hands each call of one host in one process to the handler of its role
stepping     steps and optimizers         rasterizing  views, rasterizations, the pressure
aligning     rows added and removed       saving       sidecars and checkpoints
state        the run and its models, shared by all handlers
proofs       has calls of the host's own rasterizer proved, and keeps the proofs
patching     wraps functions and restores them
similarity   answers the hosts' SSIM on a CPU
stand_ins    replace the host's compiled packages
ranks        refuses several processes that train one model together
workers      prepares worker processes that the host spawns
"""
