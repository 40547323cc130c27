"""The kit's pytest plugin: a table of adapters and invariants at the end, or in a file.

Load it with ``pytest_plugins =
["fragprune_plugins.testing.plugin"]`` in the topmost ``conftest.py``, or ``pytest -p
fragprune_plugins.testing.plugin``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

RESULTS = pytest.StashKey[list[dict[str, Any]]]()
WHAT = "fragprune invariant"
NOT_APPLICABLE = "n/a: "
"""Begins the reason where a promise cannot be asked of a host; where this machine lacks something,
the test is skipped."""
_SIGNS = {"passed": "ok", "failed": "FAILED"}


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option ``--fragprune-report``."""
    parser.getgroup("fragprune").addoption(
        "--fragprune-report",
        metavar="FILE",
        help="Write what the conformance kit found, adapter by invariant, as JSON.",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Make an empty list of results."""
    config.stash[RESULTS] = []


def pytest_itemcollected(item: pytest.Item) -> None:
    """Note the adapter and the invariant of a test, for its report."""
    kind: Any = getattr(item, "cls", None)
    place = getattr(item, "callspec", None)
    if hasattr(kind, "longest_order") and place is not None and "place" in place.params:
        adapter = kind.adapter if isinstance(kind.adapter, str) else kind.adapter.name
        name = getattr(item, "originalname", item.name)
        invariant = name.removeprefix("test_").replace("_", " ")
        item.user_properties.append((WHAT, [adapter, place.id, invariant]))


class _Collector:
    """Turns reports of tests into results."""

    def __init__(self, results: list[dict[str, Any]]) -> None:
        self.results = results

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep the outcome of the test itself, or of a failed set-up."""
        properties: dict[str, Any] = dict(report.user_properties)
        if WHAT not in properties or (report.when != "call" and report.passed):
            return
        adapter, host, invariant = properties[WHAT]
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longreprtext
        reason = "" if report.passed else str(reason).strip().removeprefix("Skipped: ")
        inapplicable = report.skipped and reason.startswith(NOT_APPLICABLE)
        self.results.append(
            {
                "adapter": adapter,
                "host": host,
                "invariant": invariant,
                "outcome": "n/a" if inapplicable else report.outcome,
                "reason": reason.removeprefix(NOT_APPLICABLE),
                "seconds": round(report.duration, 2),
            }
        )


def pytest_sessionstart(session: pytest.Session) -> None:
    """Register the collector of results."""
    session.config.pluginmanager.register(_Collector(session.config.stash[RESULTS]))


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print a row for each adapter, a column for each invariant, and reasons of skips."""
    results = config.stash[RESULTS]
    if not results:
        return
    if target := config.getoption("--fragprune-report"):
        Path(target).write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    terminalreporter.section("fragprune conformance")
    for line in table(results):
        terminalreporter.line(line)
    for result in results:
        if result["outcome"] in ("n/a", "skipped"):
            terminalreporter.line(
                "{outcome}: {adapter} on {host}, {invariant}: {reason}".format(**result)
            )


def table(results: list[dict[str, Any]]) -> list[str]:
    """The results as lines of text, one for each adapter and host."""
    columns = list(dict.fromkeys(result["invariant"] for result in results))
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for result in results:
        row = rows.setdefault((result["adapter"], result["host"]), {})
        row[result["invariant"]] = _SIGNS.get(result["outcome"], result["outcome"])
    heads = ("adapter", "host")
    widths = [max(len(head), *(len(key[i]) for key in rows)) + 2 for i, head in enumerate(heads)]
    cells = [max(len(column), 7) + 2 for column in columns]

    def line(names: tuple[str, str], values: list[str]) -> str:
        left = "".join(f"{name:<{width}}" for name, width in zip(names, widths, strict=True))
        right = "".join(f"{value:<{width}}" for value, width in zip(values, cells, strict=True))
        return (left + right).rstrip()

    body = [line(key, [row.get(column, "-") for column in columns]) for key, row in rows.items()]
    return [line(heads, columns), *body]
