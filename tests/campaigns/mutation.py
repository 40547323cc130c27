"""``python -m tests.campaigns.mutation``: changes the code, and counts how often tests notice.

mutmut makes and runs the mutants; ``[tool.mutmut]`` in ``pyproject.toml`` names modules and tests.
This command draws a sample of them, because all take hours, and prints a table. The exit code is 1
if less than the wanted share of any module's was noticed.
"""

import argparse
import importlib.util
import json
import math
import os
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path

MADE = Path("mutants")
PROBE = "fragprune_plugins.files.reading.x_said__mutmut_1"

# mutmut's exit codes: https://github.com/boxed/mutmut/blob/main/src/mutmut/stats.py
OUTCOMES = {0: "survived", 1: "killed", 3: "killed", 5: "not reached", 33: "not reached"}
OUTCOMES |= dict.fromkeys((24, -24, 36, 152, 255), "out of time")
ENDED = ("killed", "out of time")
"""Outcomes of mutants that were noticed."""


def main() -> int:
    """Make mutants, run a sample of each module, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.mutation", description=__doc__)
    parser.add_argument("modules", nargs="*", help="parts of their names; default: all")
    parser.add_argument("--sample", type=int, default=60, help="mutants of each (60); 0: all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample (0)")
    parser.add_argument("--again", action="store_true", help="also those that were run before")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="default: one a core")
    parser.add_argument("--wanted", type=float, default=0.85, help="share of each module (0.85)")
    parser.add_argument("--table", action="store_true", help="run nothing, print what is known")
    words = parser.parse_args()
    if not words.table and importlib.util.find_spec("mutmut") is None:
        parser.error("mutmut is not installed: pip install 'mutmut>=3.8,<4'")
    if not words.table:
        if _is_stale():
            _mutmut(words.processes, [PROBE])  # makes all of them, where a module has changed
        wanted = _sample(words.modules, words.sample, words.seed)
        known = {} if words.again else _outcomes(words.modules)
        if todo := [name for name in wanted if known.get(name) in (None, "survived")]:
            _mutmut(words.processes, todo)
    return table(_outcomes(words.modules), words.wanted)


def _mutmut(processes: int, names: list[str]) -> None:
    """Let mutmut run mutants; one thread each, since threads do not survive a fork."""
    command = [sys.executable, "-m", "mutmut", "run", "--max-children", str(processes), *names]
    subprocess.run(command, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})


def _is_stale() -> bool:
    """Whether there are no mutants yet, or a module has changed since they were made."""
    made = [each.with_suffix("") for each in MADE.glob("fragprune_plugins/**/*.meta")]
    changed = (each.relative_to(MADE).stat().st_mtime > each.stat().st_mtime for each in made)
    return not made or any(changed)


def _by_module(modules: list[str]) -> dict[str, dict[str, int | None]]:
    """By module, the exit code of each mutant; None for one that was not run."""
    found = {}
    for file in sorted(MADE.glob("fragprune_plugins/**/*.meta")):
        codes = json.loads(file.read_text())["exit_code_by_key"]
        name = ".".join(file.relative_to(MADE).with_suffix("").with_suffix("").parts[1:])
        if codes and (not modules or any(part in name for part in modules)):
            found[name] = codes
    return found


def _sample(modules: list[str], count: int, seed: int) -> list[str]:
    """Names of so many mutants of each module; of the same code and seed the same ones."""
    chosen: list[str] = []
    for names in map(sorted, _by_module(modules).values()):
        mixed = random.Random(seed).sample(names, len(names))  # a larger sample has the smaller one
        chosen += mixed[: count or len(names)]
    return chosen


def _outcomes(modules: list[str]) -> dict[str, str | None]:
    return {
        name: None if code is None else OUTCOMES.get(code, "odd")
        for codes in _by_module(modules).values()
        for name, code in codes.items()
    }


def table(outcomes: dict[str, str | None], wanted: float) -> int:
    """Print outcomes by module, with a 95 % interval of the share; returns the exit code."""
    kinds = ("killed", "out of time", "survived", "not reached", "odd")
    print("| module | mutants | run | " + " | ".join(kinds) + " | share, 95 % |")
    print("|---|" + "---|" * (len(kinds) + 3))
    rows: dict[str, Counter[str | None]] = {}
    for name, outcome in outcomes.items():
        module = name.removeprefix("fragprune_plugins.").split(".x")[0]
        for row in (module, "all"):
            rows.setdefault(row, Counter())[outcome] += 1
    rows["all"] = rows.pop("all", Counter())
    low = False
    for module, counts in rows.items():
        ran = counts.total() - counts[None]
        killed = sum(counts[kind] for kind in ENDED)
        low |= killed < wanted * ran
        figures = " | ".join(str(counts[kind]) for kind in kinds)
        print(f"| {module} | {counts.total()} | {ran} | {figures} | {share(killed, ran)} |")
    return int(low)


def share(killed: int, ran: int) -> str:
    """A share with Wilson's interval."""
    if not ran:
        return ""
    part, z = killed / ran, 1.96
    middle = (part + z * z / (2 * ran)) / (1 + z * z / ran)
    half = z * math.sqrt(part * (1 - part) / ran + (z / (2 * ran)) ** 2) / (1 + z * z / ran)
    return f"{part:.0%} ({middle - half:.0%} to {min(1, middle + half):.0%})"


if __name__ == "__main__":
    raise SystemExit(main())
