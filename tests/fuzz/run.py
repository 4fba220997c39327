"""Feed damaged files to the readers and random settings to the recipes, for as long as one likes.

    python tests/fuzz/run.py files --seconds 600          # or --cases 3000
    python tests/fuzz/run.py settings --seconds 600
    python tests/fuzz/run.py files --only policy --first 17 --cases 1   # a failure once more

Allowed is that a file is read, or refused by an error of this package in one line; that a recipe works, or prints one
`error:` line, exits with 2 and leaves the folder as it was. A traceback, a crash, a hang or more memory than 2 GiB
beyond the imports is a failure; it is printed with the number that makes it again. Exit code 1 if there was one.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fuzz import commands, readers
from fuzz.arena import Case, Outcome, play

PATIENCE = {"files": 60.0, "settings": 90.0}
"""Seconds that a case may take."""


def cases_of(what: str) -> dict[str, Case]:
    """The cases by their kind, imported and compiled."""
    if what == "files":
        readers.warm_up()
        return readers.READERS
    commands.warm_up()
    return {**commands.CHECKS, **commands.RUNS}


def fuzz(
    what: str, *, seconds: float = float("inf"), cases: int | None = None, first: int = 0, only: Sequence[str] = ()
) -> Iterator[Outcome]:
    """The outcomes of cases of all kinds in turn, until the time is over or there were enough."""
    kinds = {kind: case for kind, case in cases_of(what).items() if not only or kind in only}
    until = time.monotonic() + seconds
    every = ((kind, number) for number in itertools.count(first) for kind in kinds)
    numbers = itertools.takewhile(lambda _: time.monotonic() < until, itertools.islice(every, cases))
    yield from play(kinds, numbers, PATIENCE[what], fresh=what == "settings")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Fuzz the readers of files, or the settings of the recipes.")
    parser.add_argument("what", choices=sorted(PATIENCE))
    parser.add_argument("--seconds", type=float, default=60.0, help="stop after that time")
    parser.add_argument("--cases", type=int, default=None, help="stop after so many cases")
    parser.add_argument("--first", type=int, default=0, help="number of the first case of each kind")
    parser.add_argument("--only", nargs="*", default=(), help="kinds of cases")
    given = parser.parse_args(arguments)
    seconds = given.seconds if given.cases is None else float("inf")
    counted: Counter[tuple[str, str]] = Counter()
    with contextlib.suppress(KeyboardInterrupt):
        for outcome in fuzz(given.what, seconds=seconds, cases=given.cases, first=given.first, only=given.only):
            counted[outcome.kind, outcome.verdict] += 1
            if outcome.failed:
                print(f"{outcome.kind} {outcome.number}: {outcome.verdict}\n{outcome.detail}\n", flush=True)
    for (kind, verdict), times in sorted(counted.items()):
        print(f"{kind:24} {verdict:12} {times:6}")
    return int(any(verdict not in ("loaded", "refused") for _, verdict in counted))


if __name__ == "__main__":
    sys.exit(main())
