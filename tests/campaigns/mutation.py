"""``python -m tests.campaigns.mutation``: changes the code, and counts how often tests notice.

mutmut makes and runs the mutants; ``[tool.mutmut]`` in ``pyproject.toml`` names modules and tests.
This command draws a sample of them, because all take hours, and prints a table. The exit code is 1
if less than 85 % of any module's were noticed.
"""

import argparse
import ast
import json
import math
import os
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path

MADE = Path("mutants")
SMALL = Path("fragprune_plugins/files/reading.py")
WANTED = 0.85

# mutmut's exit codes: https://github.com/boxed/mutmut/blob/main/src/mutmut/stats.py
NOTICED = (1, 3, 24, -24, 36, 152, 255)  # the tests failed, or ran out of time
NOT_REACHED = (5, 33)


def main() -> int:
    """Make mutants, run a sample of each module, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.mutation", description=__doc__)
    parser.add_argument("modules", nargs="*", help="parts of their names; default: all")
    parser.add_argument("--sample", type=int, default=60, help="mutants of each (60); 0: all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample (0)")
    words = parser.parse_args()
    mutmut([one_of(SMALL)])  # makes all of them, where a module has changed
    wanted: list[str] = []
    for codes in by_module(words.modules).values():
        mixed = random.Random(words.seed).sample(sorted(codes), len(codes))
        wanted += mixed[: words.sample or None]  # a larger sample has the smaller one
    mutmut(wanted)
    return table(by_module(words.modules))


def one_of(file: Path) -> str:
    """The first mutant of a module's first function, by mutmut's name for it."""
    functions = (x for x in ast.parse(file.read_text()).body if isinstance(x, ast.FunctionDef))
    name = next(each.name for each in functions if not each.decorator_list)
    return f"{'.'.join(file.with_suffix('').parts)}.x_{name}__mutmut_1"


def mutmut(names: list[str]) -> None:
    """Let mutmut run mutants; one thread each, since threads do not survive a fork."""
    command = [sys.executable, "-m", "mutmut", "run", "--max-children", str(os.cpu_count()), *names]
    subprocess.run(command, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})


def by_module(modules: list[str]) -> dict[str, dict[str, int | None]]:
    """By module, the exit code of each mutant; None for one that was not run."""
    found = {}
    for file in sorted(MADE.glob("fragprune_plugins/**/*.meta")):
        name = ".".join(file.relative_to(MADE).with_suffix("").with_suffix("").parts[1:])
        if not modules or any(part in name for part in modules):
            found[name] = json.loads(file.read_text())["exit_code_by_key"]
    return found


def table(modules: dict[str, dict[str, int | None]]) -> int:
    """Print what became of each module's, with Wilson's interval; returns the exit code."""
    print("| module | mutants | run | noticed | not reached | share, 95 % |")
    print("|---|---|---|---|---|---|")
    low = False
    for module, codes in modules.items():
        counts = Counter(codes.values())
        ran, noticed = len(codes) - counts[None], sum(counts[code] for code in NOTICED)
        low |= noticed < WANTED * ran
        unreached = sum(counts[code] for code in NOT_REACHED)
        cells = (module, len(codes), ran, noticed, unreached, share(noticed, ran))
        print("| " + " | ".join(map(str, cells)) + " |")
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
