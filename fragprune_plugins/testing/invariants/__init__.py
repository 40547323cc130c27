"""The promises that every adapter keeps, each as a check of one host in a process of its own.

A check raises AssertionError with the difference if the promise is broken.
"""

from __future__ import annotations

from fragprune_plugins.testing.invariants.case import Case as Case
from fragprune_plugins.testing.invariants.drawing import monotone as monotone
from fragprune_plugins.testing.invariants.drawing import neutral_is_the_host as neutral_is_the_host
from fragprune_plugins.testing.invariants.drawing import same_picture as same_picture
from fragprune_plugins.testing.invariants.learning import alignment as alignment
from fragprune_plugins.testing.invariants.learning import checkpoint as checkpoint
from fragprune_plugins.testing.invariants.learning import freeze as freeze
from fragprune_plugins.testing.invariants.learning import model_file as model_file
from fragprune_plugins.testing.invariants.patching import nothing_stays as nothing_stays
from fragprune_plugins.testing.invariants.patching import off_is_off as off_is_off
from fragprune_plugins.testing.invariants.patching import orders as orders
from fragprune_plugins.testing.invariants.patching import refuse as refuse
