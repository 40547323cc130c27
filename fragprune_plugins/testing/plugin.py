"""The kit's pytest plugin: a table of adapters and invariants at the end, or in a file.

Name ``fragprune_plugins.testing.plugin`` in ``pytest_plugins`` of the topmost ``conftest.py``, or
after ``pytest -p``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

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


def pytest_itemcollected(item: pytest.Item) -> None:
    """Note the adapter and the invariant of a test, for its report."""
    kind: Any = getattr(item, "cls", None)
    place = getattr(item, "callspec", None)
    if hasattr(kind, "longest_order") and place is not None and "place" in place.params:
        adapter = kind.adapter if isinstance(kind.adapter, str) else kind.adapter.name
        name = getattr(item, "originalname", item.name)
        invariant = name.removeprefix("test_").replace("_", " ")
        item.user_properties.append((WHAT, [adapter, place.id, invariant]))


def results_of(stats: dict[str, list[Any]]) -> list[dict[str, Any]]:
    """What became of the kit's tests, in their order: outcomes of tests, and of failed set-ups."""
    kept = (each for kind in stats.values() for each in kind)  # items and warnings are among them
    reports = [each for each in kept if isinstance(each, pytest.TestReport)]
    results = []
    for report in sorted(reports, key=lambda each: each.start):
        properties: dict[str, Any] = dict(report.user_properties)
        if WHAT not in properties or (report.when != "call" and report.passed):
            continue
        adapter, host, invariant = properties[WHAT]
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longreprtext
        reason = "" if report.passed else str(reason).strip().removeprefix("Skipped: ")
        inapplicable = report.skipped and reason.startswith(NOT_APPLICABLE)
        results.append(
            {
                "adapter": adapter,
                "host": host,
                "invariant": invariant,
                "outcome": "n/a" if inapplicable else report.outcome,
                "reason": reason.removeprefix(NOT_APPLICABLE),
                "seconds": round(report.duration, 2),
            }
        )
    return results


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print a row for each adapter, a column for each invariant, and reasons of skips."""
    results = results_of(terminalreporter.stats)
    if not results:
        return
    if target := config.getoption("--fragprune-report"):
        Path(target).write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    terminalreporter.section("fragprune conformance")
    for line in table(results):
        terminalreporter.line(line)
    for result in results:
        if result["outcome"] in ("n/a", "skipped"):
            told = "{outcome}: {adapter} on {host}, {invariant}: {reason}"
            terminalreporter.line(told.format(**result))


def table(results: list[dict[str, Any]]) -> list[str]:
    """The results as lines of text, one for each adapter and host."""
    columns = list(dict.fromkeys(result["invariant"] for result in results))
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for result in results:
        row = rows.setdefault((result["adapter"], result["host"]), {})
        row[result["invariant"]] = _SIGNS.get(result["outcome"], result["outcome"])
    lines = [("adapter", "host", *columns)]
    lines += [(*key, *(row.get(column, "-") for column in columns)) for key, row in rows.items()]
    widths = [max(map(len, cells)) + 2 for cells in zip(*lines, strict=True)]
    padded = [[f"{c:<{w}}" for c, w in zip(line, widths, strict=True)] for line in lines]
    return ["".join(cells).rstrip() for cells in padded]
