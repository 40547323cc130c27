"""``fragprune run`` with a host in which stage 2 is a training method of its own.

The host runs that method in place of the one that the command names. The method activates a session
itself, also without ``fragprune run``.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from fragprune_plugins.adapting import HostRepo, NotComparedError, hookimpl
from fragprune_plugins.errors import HostFailed
from fragprune_plugins.injection import process, ranks
from fragprune_plugins.injection.options import RunOptions, RunSummary
from fragprune_plugins.injection.session import active_session
from fragprune_plugins.learning.events import StepStats, Summary
from fragprune_plugins.learning.interruption import sigterm_interrupts
from fragprune_plugins.plugins.loading import installed

log = logging.getLogger("fragprune")


class Recorder:
    """A plugin that records the curves and the summary of a session."""

    def __init__(self) -> None:
        self.summary: Summary | None = None
        self.curves: list[dict[str, float]] = []

    @hookimpl
    def fragprune_step(self, stats: StepStats) -> None:
        """Record a step."""
        self.curves.append(asdict(stats))

    @hookimpl
    def fragprune_finished(self, summary: Summary) -> None:
        """Record the summary."""
        self.summary = summary


def run(
    name: str,
    repo: HostRepo,
    rewritten: Callable[..., list[str]],
    evaluation: str,
    script: Path,
    arguments: list[str],
    module: str,
    options: RunOptions,
) -> RunSummary:
    """Run the method that has stage 2 in it.

    Args:
        rewritten: gives the method's arguments for those of the command; see ``command.rewritten``.
        evaluation: the command that measures held-out views, as text for people.
        module: the module's name in ``python -m module``; "" for a script.

    Raises:
        HostFailed: the host failed, or ended before the end of stage 2.
    """
    started, recorder, plugins = time.perf_counter(), Recorder(), installed()
    ranks.expect_one()
    device = process.host_device(options.device, options.engine)
    asked = {name: getattr(options, name) for name in ("settings", "stage", "from_iter", "engine")}
    words = rewritten(arguments, device=device, **asked)
    log.info("runs %s %s", script.stem, " ".join(words))
    plugins.register(recorder, "run")
    try:
        with (
            process.telling(script, repo.root),
            process.host_process(script, words, device, Path.cwd()),
            sigterm_interrupts(),
        ):
            process.run_main(script, module)
    finally:
        plugins.remove("run")
        session = active_session()
        output = session.output if session is not None else None
        if session is not None:
            session.deactivate()
    learned = recorder.summary
    if learned is None:
        found, expected = "ended before the end of stage 2", "a training that runs to its end"
        raise HostFailed(script.name, found, expected, process.READ)
    frame = "photographs and cameras in the host's own frame"
    return RunSummary(
        **vars(learned) | {"adapter": name},
        device=device,
        stage=options.stage,
        train_seconds=time.perf_counter() - started,
        curves=recorder.curves,
        output=output,
        not_compared=NotComparedError(name, frame, "its own evaluation", f"Run: {evaluation}"),
    )
