"""``cd tests && python -m campaigns.fuzz``: feeds broken files to every reader.

``python -m campaigns.fuzz commands``: to commands, in a scene of which the rest is good.

The exit code is 1 if any reader raises what is not ours, gives nonsense, takes more than a minute
or a gibibyte, or dies.
"""

import argparse
import hashlib
import time
from pathlib import Path

import torch
from campaigns.fuzz.commands import COMMANDS
from campaigns.fuzz.readers import BY_NAME
from campaigns.fuzz.running import BAD, Tally, run


def main() -> int:
    """Run, print a table, and keep the inputs that broke something."""
    parser = argparse.ArgumentParser(prog="python -m campaigns.fuzz", description=__doc__)
    parser.add_argument("readers", nargs="*", help=f"of {', '.join(BY_NAME)}, commands")
    parser.add_argument("--inputs", type=int, default=2000, help="of each reader (2000)")
    parser.add_argument("--seconds", type=float, default=1e9, help="for each reader")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="default: the clock")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-found"), help="folder for findings")
    words = parser.parse_args()
    if unknown := set(words.readers) - {*BY_NAME, "commands"}:
        parser.error(f"no reader {', '.join(sorted(unknown))}")
    torch.set_num_threads(1)
    print(f"seed {words.seed}")
    print(f"{'reader':<36}{'inputs':>9}{'read':>9}{'stated':>9}" + "".join(f"{b:>9}" for b in BAD))
    every = Tally()
    readers = [BY_NAME[name] for name in words.readers or BY_NAME if name in BY_NAME]
    for reader in [*readers, *(COMMANDS if "commands" in words.readers else ())]:
        tally = run(reader, words.inputs, seed=words.seed, seconds=words.seconds)
        print(row(reader.name, tally), flush=True)
        every.outcomes += tally.outcomes
        for (kind, said), content in tally.found.items():
            words.keep.mkdir(parents=True, exist_ok=True)
            file = words.keep / f"found-{hashlib.sha256(content).hexdigest()[:12]}"
            file.write_bytes(content)
            print(f"    {kind}: {said[:150]} ({file})", flush=True)
    print(row("all", every))
    return 1 if every.bad else 0


def row(name: str, tally: Tally) -> str:
    kinds = ("read", "stated", *BAD)
    return f"{name:<36}{tally.inputs:>9}" + "".join(f"{tally.outcomes[kind]:>9}" for kind in kinds)


if __name__ == "__main__":
    raise SystemExit(main())
