"""Mutation testing: how many small faults, put into the code one at a time, do the tests notice?

    python tools/mutation map --jobs 16              # once: which test runs which line, and how long it takes
    python tools/mutation run --jobs 16 --count 300  # resumable; writes build/mutants/report.json

A mutant changes one thing inside a function of `FOLDERS`: an operator, a comparison, a number, a condition, a returned
value or a call whose result is not used; never a docstring, a message or a log. The sample depends on the seed and the
code alone: a mutant's rank is the hash of its place by name, so that edits elsewhere do not change it.

`map` runs the suite once and keeps by line the tests that pass and run it. `run` applies each mutant in a copy of the
tree and runs the tests of its line, the quickest first, until one fails or `--budget` seconds of tests have passed; of
a line that no mapped test runs, the tests of the folder that mirrors its own. A mutant survives when none fails; with a
larger budget the same command goes on with the tests that are left. At the end the tests that killed run on the
unchanged copy: one that fails there kills nothing.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from changes import FOLDERS, sample
from line_map import make_map
from runs import run


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("map", "run", "list"))
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parents[2], help="tree to test")
    parser.add_argument("--work", type=Path, help="folder of the map and the results; default: ROOT/build/mutants")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at a time")
    parser.add_argument("--count", type=int, default=300, help="mutants of the sample")
    parser.add_argument("--seed", type=int, default=1, help="seed of the sample")
    parser.add_argument("--budget", type=float, default=20.0, help="seconds of tests for each mutant")
    parser.add_argument("--limit", type=float, help="seconds after which the map ends, or no further mutant begins")
    parser.add_argument("--folders", nargs="+", default=list(FOLDERS), help="folders to change")
    parser.add_argument("--without", nargs="*", default=[], help="tests that do not count")
    options, words = parser.parse_known_args()
    root = options.root.resolve()
    work = (options.work or root / "build" / "mutants").resolve()
    work.mkdir(parents=True, exist_ok=True)
    if options.what == "map":
        make_map(root, work, options.jobs, options.limit, words)
    elif words:
        parser.error(f"unknown arguments: {words}")
    elif options.what == "list":
        for mutant in sample(root, options.count, options.seed, options.folders):
            print(f"{mutant.path}:{mutant.line}: {mutant.name}")
    else:
        run(root, work, options)


if __name__ == "__main__":
    main()
