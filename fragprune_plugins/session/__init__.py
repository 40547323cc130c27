"""The session: what happens at each seam of a running host.

core      one host in one process: its seams, its models, what all handlers share
learning  steps and optimizers        drawing  views, rasterizations, the pressure
rows      models that change          files    sidecars and checkpoints
"""

from fragprune_plugins.session.core import Session, active_session
from fragprune_plugins.session.state import PopulationChange, StepStats, Summary

__all__ = ["PopulationChange", "Session", "StepStats", "Summary", "active_session"]
