"""A command: prints its report or its error, and sets the exit code."""

from __future__ import annotations

import contextlib
import difflib
import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import click

from fragprune_plugins import errors
from fragprune_plugins.errors import FragpruneError, UsageError, printable
from fragprune_plugins.learning.interruption import EXIT_CODE, Terminate
from fragprune_plugins.workbench.commands.rules import Rules
from fragprune_plugins.workbench.figures.records import strict
from fragprune_plugins.workbench.ranks import launched, should_print

JSON = "fragprune.json"  # key of a bool in the context's ``meta``: stdout gets only one JSON object
WORDS = "fragprune.words"  # key of the command's words there


@dataclass(frozen=True)
class Report:
    """The output of a command."""

    data: dict[str, Any]  # the object that --json prints
    text: str  # for a person
    exit_code: int = 0  # 1 if the check failed; 130 or 143 if learning was interrupted and saved


class Command(click.Command):
    """A command whose function returns a ``Report``: prints it and sets the exit code.

    Of several processes one prints; None says that another one reports.

    A ``FragpruneError`` gives exit code 1, a usage error 2, Ctrl-C 130, SIGTERM during learning
    143. Any other exception keeps its traceback. ``rules`` say which of its options exclude or need
    each other; they are checked before anything is done.
    """

    def __init__(self, *args: Any, rules: Rules = (), **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.rules = rules
        said = "Print one JSON object on stdout."
        self.params.append(click.Option(["--json", "as_json"], is_flag=True, help=said))

    def get_short_help_str(self, limit: int = 45) -> str:
        """The whole first sentence of --help: lists of commands wrap it instead of cutting it."""
        return super().get_short_help_str(max(limit, 200))

    def make_context(self, info_name: str | None, args: list[str], *more: Any, **extra: Any) -> Any:
        """Parse the words; with --json among them, a usage error is printed as JSON."""
        words = list(args)
        try:
            context = super().make_context(info_name, args, *more, **extra)
        except click.UsageError as error:
            raise usage_error(error, words) from error
        except FragpruneError as error:  # of a type of an argument
            raise _stated(error, as_json="--json" in _ours(words)) from error
        context.meta[WORDS] = words
        return context

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command, print its report or error, and exit with its code."""
        as_json = ctx.meta[JSON] = bool(ctx.params.pop("as_json"))
        try:
            for rule in self.rules:
                rule.check(ctx)
            with _machine_stated(ctx.command_path):
                report: Report | None = super().invoke(ctx)
        except FragpruneError as error:
            raise _stated(error, as_json=as_json) from error
        except KeyboardInterrupt as error:
            if should_print():
                click.echo("Interrupted.", err=True)
            ctx.exit(EXIT_CODE if isinstance(error, Terminate) else 130)
        if report is None:
            ctx.exit(0)
        if isinstance(ctx.obj, list):
            ctx.obj.append(report)
        click.echo(json.dumps(strict(report.data)) if as_json else printable(report.text))
        ctx.exit(report.exit_code)


def work_of(package: str, **options: Any) -> Report:
    """Do a command's work, of its package's ``work.py``, imported on use: --help needs no torch."""
    name = package.rpartition(".")[2]
    work: Callable[..., Report] = getattr(import_module(f"{package}.work"), name)
    expect_numpy()
    return work(**options)


def expect_numpy() -> None:
    """Raise EngineError for a NumPy 2 that torch cannot use: before 2.3 it was compiled for 1."""
    torch, numpy = sys.modules.get("torch"), sys.modules.get("numpy")
    if torch is None or numpy is None:
        return
    try:
        torch.empty(0).numpy()
    except RuntimeError as error:
        found = f"NumPy {numpy.__version__}, for which it was not compiled"
        remedy = 'Run: pip install "numpy<2"'
        raise errors.EngineError(f"torch {torch.__version__}", found, "NumPy 1", remedy) from error


class Group(click.Group):
    """Commands under one name; with --json, an unknown one is printed as JSON."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command that the first word names, and the other words."""
        words = list(args)
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            near = difflib.get_close_matches(words[0], self.list_commands(ctx))
            meant = f"Did you mean {' or '.join(near)}?" if near else "The list: --help."
            told = click.UsageError(f"{error.message} {meant}", error.ctx)
            raise usage_error(told, words) from error


def _stated(error: FragpruneError, *, as_json: bool) -> click.exceptions.Exit:
    """Print an error, as JSON on stdout if asked for; returns the exit with its code."""
    if should_print():
        text = json.dumps({"error": error.as_dict()}) if as_json else str(error)
        click.echo(text, err=not as_json)
    codes = {UsageError: 2, errors.Interrupted: 130, errors.Terminated: EXIT_CODE}
    return click.exceptions.Exit(codes.get(type(error), 1))


def _ours(words: list[str]) -> list[str]:
    """The words of a command line that are not a host's command."""
    return words[: words.index("--")] if "--" in words else words


@contextlib.contextmanager
def _machine_stated(where: str) -> Iterator[None]:
    """State what the machine refuses wherever a command meets it: a path, or memory."""
    try:
        os.getcwd()  # where that folder is gone, torch ends the process without a word of ours
        yield
    except OSError as error:
        if not (error.filename or isinstance(error, FileNotFoundError)):  # a closed pipe, for one
            raise
        found, expected = error.strerror or str(error), "a path that the system takes"
        remedy = "Choose another name or place, or free space and permissions there."
        path = str(error.filename or where)
        raise errors.PathError(path, found, expected, remedy) from error
    except (MemoryError, RuntimeError) as error:
        words = str(error).split("\n", 1)[0][:200]
        known = "allocate memory" in words or "out of memory" in words  # torch's, of CPU and GPU
        if not (known or isinstance(error, MemoryError)):
            raise
        found = f"no memory left ({words or 'MemoryError'})"
        remedy = "Close other programs, or lower the pictures' size with --resolution."
        fits = "a model and pictures that fit"
        raise errors.MemoryLimitError(where, found, fits, remedy) from error


def usage_error(error: click.UsageError, words: list[str]) -> Exception:
    """What to raise for a usage error: with --json an exit, once the error is printed."""
    if not should_print():
        return click.exceptions.Exit(2)
    if "--json" not in _ours(words):
        return error
    where = error.ctx.command_path if error.ctx else "fragprune"
    found, remedy = error.format_message(), f"Run {where} --help."
    return _stated(UsageError(where, found, "options of this command", remedy), as_json=True)


@contextlib.contextmanager
def first_process_prints() -> Iterator[None]:
    """Inside, only the first of several processes prints."""
    with contextlib.ExitStack() as stack:
        if not launched().first:
            nowhere = stack.enter_context(open(os.devnull, "w"))
            stack.enter_context(contextlib.redirect_stdout(nowhere))
            stack.enter_context(contextlib.redirect_stderr(nowhere))
        yield
