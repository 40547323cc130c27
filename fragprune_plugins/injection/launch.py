"""Runs a host's command in this process: finds the host and its adapter, and runs the stages."""

from __future__ import annotations

import tempfile
import time
from contextlib import nullcontext
from functools import partial
from pathlib import Path

from fragprune_plugins.errors import UsageError, log
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.atomic import locked, replacing
from fragprune_plugins.hosts import preflight
from fragprune_plugins.hosts.adapter import HostAdapter, ScriptAdapter
from fragprune_plugins.hosts.choosing import choose, locate, usage
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection import process, ranks, starting
from fragprune_plugins.injection.command import HostCommand, split
from fragprune_plugins.injection.options import RunOptions, RunSummary
from fragprune_plugins.injection.stages import Stages
from fragprune_plugins.plugins.hooks import engine_for, select_adapter
from fragprune_plugins.plugins.loading import Plugins, installed

__all__ = ["RunOptions", "RunSummary", "run"]


def run(command: list[str], options: RunOptions | None = None) -> RunSummary:
    """Run a host's command with fragment pruning.

    Args:
        command: words of the command, ``["python", "train.py", "-s", "scene", ...]``; a leading
            python is optional.
        options: options of the run; None for the defaults.

    Raises:
        UsageError: the command names no script, or the device does not exist.
        EngineError: the engine does not exist or cannot run here.
        UnknownHostError: no adapter fits the script's folder.
        HostNeedsError: packages that the script imports, or its data, are missing.
        HostFailed: the host raised an exception or ended with an error code.
        OutputError: another process trains into the same folder.
        RanksError: several processes train the model together.
        Interrupted: Ctrl-C in stage 2, or SIGTERM (Terminated). Learned thresholds were saved.
        DivergedError: NaN or infinity in stage 2. Nothing of it was saved.
        SessionError: steps were counted as learned, and no view was drawn with thresholds.
    """
    options = options or RunOptions()
    ranks.expect_no_launcher(command)
    script, arguments, module = split(command)
    plugins = installed()
    repo, adapter = _host(script, module, options.adapter, plugins)
    trainer = adapter.trainer(repo, script)
    if trainer is None:
        found = f"{adapter.info.title}, a library without a training command"
        remedy = f"See the how-to page of {adapter.name}."
        raise UsageError("fragprune run", found, usage(adapter, repo), remedy)
    if not isinstance(trainer, ScriptAdapter):
        summary: RunSummary = trainer(script, arguments, module, options)
        return summary
    host = HostCommand(script, arguments, trainer.command_line(repo), module)
    device = process.host_device(options.device, options.engine)
    _expect_engine(trainer, options, device, plugins)
    started = time.perf_counter()
    trains = _expect_trainable(host, repo, trainer, options, device)
    own = "run" if options.stage == "auto" or options.settings.goal.presses else "control"
    alone = locked(host.output.resolve(), 0, own) if trains and host.output else nullcontext()
    with tempfile.TemporaryDirectory(prefix="fragprune-") as scratch, alone:
        stages = Stages(host, repo, trainer, plugins, options, device, Path(scratch))
        named = {"off": stages.observe, "joint": stages.joint, "finetune": stages.finetune}
        named.get(options.stage if trains else "off", stages.train_then_finetune)()
        if trains and own == "run":
            starting.forget(host)
        own = str(host.flags.config or "") if host.line.config else ""
        for kept in stages.output.glob("cfg_args") if own and stages.output else ():
            with replacing(kept) as new:
                new.write_text(kept.read_text().replace(f"{scratch}/{Path(own).name}", own))
    return stages.summary(time.perf_counter() - started)


def _host(
    script: Path, module: str, name: str | None, plugins: Plugins
) -> tuple[HostRepo, HostAdapter]:
    """The host of a script, or of ``python -m module``, and its adapter.

    The host is a checkout or an installed package; ``module`` is "" for a script.
    """
    select = partial(select_adapter, plugins=plugins)
    top = module.split(".")[0]
    package = HostRepo.installed(top) if module else None
    if package is not None and script.is_relative_to(package.root / top):
        return package, choose(package, plugins.adapters, name, select=select)
    return locate(HostRepo(script.parent), plugins.adapters, name, select=select)


def _expect_engine(
    adapter: ScriptAdapter, options: RunOptions, device: str, plugins: Plugins
) -> None:
    """Refuse, before stage 1, an engine that cannot draw this host on this device."""
    if options.engine != "auto":
        engine_for(options.engine, device, plugins)
    elif device != "cpu" and options.stage != "off" and not adapter.on_gpu:
        found = f"{adapter.info.title}, whose Gaussians our cuda engine cannot draw"
        expected = "--device cpu, or --engine reference, which is slow"
        remedy = "Train with --stage off on the GPU; then learn with --stage finetune --device cpu."
        raise UsageError(f"--device {device}", found, expected, remedy)


def _expect_trainable(
    host: HostCommand, repo: HostRepo, adapter: ScriptAdapter, options: RunOptions, device: str
) -> bool:
    """Whether the command trains; refuse, before stage 1, what cannot run or be followed."""
    trains = host.script in (repo.root / name for name in host.line.scripts)
    if host.line.one_run and host.flags.resume:
        trains = False  # it only evaluates
        if not sidecar.find(Path(host.flags.resume)):
            log.warning("%s has no thresholds beside it: drawn without", host.flags.resume)
    if trains and options.stage != "off":
        ranks.expect_one()
        adapter.refuse(repo, host.arguments, stage=options.stage, device=device)
        engine_for(options.engine, device)
    dialect = adapter.dialect(repo)
    answered = {*dialect.names(), *(dialect.unneeded if device == "cpu" else ())}
    data = Path(host.flags.source) if trains and host.flags.source else None
    preflight.expect(repo, host.script, answered, data)
    return trains
