"""A process after a session is the process before it, but for modules that were imported."""

import builtins
import gc
import logging
import os
import random
import signal
import sys
import threading
import warnings
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
from miniatures.runs import OPTIONS, command, edit, written
from patching.traces import Snapshot, warm_up

import fragprune_plugins
from fragprune_plugins.errors import FragpruneError, HostFailed, Interrupted
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.testing import Host
from fragprune_plugins.testing.fresh import fresh

STEP = "        loss.backward()\n"
FAIL = "        if iteration == 9:\n            note()\n            raise ValueError('theirs')\n"
CTRL_C = FAIL.replace("raise ValueError('theirs')", "signal.raise_signal(signal.SIGINT)").replace(
    "iteration == 9", "opt.iterations > 12 and iteration == 16"
)
NOTES = """
import signal

from patching.traces import random_streams


def note():
    Path(args.model_path, "streams").write_text("\\n".join(random_streams()))


"""

RUNS: dict[str, tuple[str, str, type[FragpruneError] | None]] = {
    "auto": ("auto", "", None),
    "joint": ("joint", "", None),
    "the host fails": ("joint", FAIL, HostFailed),
    "Ctrl-C while thresholds learn": ("auto", CTRL_C, Interrupted),
}
"""By name: the stage, what the host does in a step of its training, and how the run ends."""

OBJECTS = 50_000
"""Fewer would mean that the walk has missed torch."""


def host_of(folder: Path, does: str = "") -> Path:
    """The demo's host; at its end, or before it is interrupted, it notes the random streams."""
    script = written(Host, folder / "host") / "train.py"
    edit(script, "\n\ndef training(", f"{NOTES}def training(")
    edit(script, STEP, STEP + does)
    script.write_text(f"{script.read_text()}    note()\n")
    return script


def after_runs(folder: Path, scene: Path) -> dict[str, tuple[int, list[str]]]:
    """Run the host in every way; the number of objects, and what differs after each."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    warm_up()
    return {name: after_run(folder / str(i), scene, *RUNS[name]) for i, name in enumerate(RUNS)}


def after_run(folder, scene, stage, does, ends):
    script, out = host_of(folder, does), folder / "out"
    words = command(script, scene, out, 12)
    options = RunOptions(
        stage=stage,
        device="cpu",
        settings=OPTIONS.settings,
        from_iter=4 if stage == "joint" else None,
    )
    before = Snapshot()
    said = None
    try:
        run(words, options)
    except FragpruneError as error:
        said = type(error)
    assert said is ends
    gc.collect()  # in Python 3.13 a frame of contextlib holds the exception that holds the frame
    stay = [
        module
        for module, each in sys.modules.items()
        if str(getattr(each, "__file__", "")).startswith(str(script.parent))
    ]
    stay += [module for module in sys.modules if "diff_gaussian" in module]
    streams = (out / "streams").read_text().splitlines()
    return len(before.objects), before.differences(streams) + stay


def test_no_run_leaves_a_trace(photographs, tmp_path):
    """The host itself seeds the random streams; after the run they are where the host left them.

    All runs in one fresh process: what one leaves behind is the next one's beginning.
    """
    for name, (count, differences) in fresh(after_runs, tmp_path, photographs).items():
        assert count > OBJECTS, name
        assert differences == [], "\n".join([name, *differences])


def planted(folder: Path) -> list[str]:
    """Leave traces of every kind; what differs."""
    warm_up()
    before = Snapshot()
    assert before.differences() == []
    torch.save = lambda *_: None
    torch.cuda.synchronize = lambda: None
    optimizer = sys.modules[torch.optim.Optimizer.__module__]
    torch.optim.Optimizer.zero_grad = lambda self: None
    torch.Tensor.of_tests = None
    builtins.open = lambda *_: None
    optimizer.register_optimizer_step_pre_hook(print)
    warnings.simplefilter("ignore")
    logging.getLogger("fragprune").addHandler(logging.NullHandler())
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.excepthook = threading.excepthook = sys.unraisablehook = print
    sys.path.append("/left/behind")
    sys.argv.append("left behind")
    os.environ["LEFT"] = "behind"
    os.chdir(folder)
    random.random()
    np.random.rand()
    torch.set_default_dtype(torch.float64)
    torch.set_grad_enabled(False)
    torch.set_num_threads(2)
    torch.use_deterministic_algorithms(True)
    torch.autograd.set_detect_anomaly(True)
    torch.serialization.add_safe_globals([Path])
    torch.set_default_device("meta")
    return before.differences()


LEAKS = [
    *("torch.save was", "torch.cuda.synchronize was", "torch.optim.optimizer.Optimizer.zero_grad"),
    *("_global_optimizer_pre_hooks had", "builtins.open was", "Tensor.of_tests is new"),
    *("sys.excepthook was", "sys.unraisablehook was", "threading.excepthook was"),
    *("warnings:", "handlers of logging:", "signals:", "environment:", "working folder:"),
    *("sys.path:", "sys.argv:", "random streams:", "dtype:", "device:", "gradients:"),
    *("torch threads:", "determinism:", "anomalies:", "safe globals:", "function modes:"),
]


@pytest.mark.skipif(torch.__version__ < "2.5", reason="torch keeps fewer kinds")
def test_every_kind_of_planted_trace_is_found(tmp_path):
    differences = fresh(planted, tmp_path)
    missed = [leak for leak in LEAKS if not any(leak in each for each in differences)]
    assert missed == []


def session_lives(folder: Path) -> bool:
    """Whether anything keeps a session that ended, and with it the models it knew."""
    session = fragprune_plugins.activate(host=host_of(folder).parent, stage="joint")
    fragprune_plugins.deactivate()
    reference = weakref.ref(session)
    del session
    gc.collect()
    return reference() is not None


def test_nothing_keeps_a_session_that_ended(tmp_path):
    """wrapt keeps the hooks of modules that were never imported."""
    assert not fresh(session_lives, tmp_path)
