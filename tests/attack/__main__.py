"""``python -m tests.attack``: attacks the package with broken and hostile inputs, prints a table.

The exit code is 1 if anything raised a traceback, hung, crashed, or gave nonsense without a word.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # as pytest does for tests/

import torch
from attack.attacks import ATTACKS, Options, warm
from attack.running import Result, table, timed


def main() -> int:
    """Run the attacks that are named, or all."""
    parser = argparse.ArgumentParser(prog="python -m tests.attack", description=__doc__)
    parser.add_argument("--inputs", type=int, default=200, help="random ones of each kind (200)")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="default: the clock")
    parser.add_argument("--only", help="attacks with this text in their names")
    parser.add_argument("--list", action="store_true", help="print their names")
    words = parser.parse_args()
    chosen = {name: act for name, act in ATTACKS.items() if not words.only or words.only in name}
    if words.list or not chosen:
        print("\n".join(ATTACKS))
        return 0 if words.list else 2
    torch.set_num_threads(1)
    print(f"seed {words.seed}", file=sys.stderr)
    with tempfile.TemporaryDirectory(prefix="attack-") as folder:
        warm(Options(Path(folder), 0, 0))
    rows: list[tuple[str, Result, float]] = []
    for name, act in chosen.items():
        with tempfile.TemporaryDirectory(prefix="attack-") as folder:
            options = Options(Path(folder), words.inputs, words.seed)
            result, seconds = timed(lambda act=act, options=options: act(options))
        rows.append((name, result, seconds))
        print(f"{name}: {result.inputs} inputs, {result.bad} bad", file=sys.stderr, flush=True)
        for found in result.found[:20]:
            print(f"    {found}", file=sys.stderr, flush=True)
    print(table(rows))
    return 1 if any(result.bad for _, result, _ in rows) else 0


if __name__ == "__main__":
    raise SystemExit(main())
