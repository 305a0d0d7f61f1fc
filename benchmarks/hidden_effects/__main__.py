"""List the cases of a stage, or make their captures.

python -m hidden_effects list [--stage report] [--only cube/com_offset]
python -m hidden_effects make OUT [--stage report] [--only cube/com_offset] [--list drake|rough|video]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from . import STAGES, Case, cases, drake_cases, film_capture, filmed_cases, make_capture, odd_cases, rough_cases

LISTS = {"all": cases, "drake": drake_cases, "odd": odd_cases, "rough": rough_cases}


def _make(folder: Path, case: Case, truth: Path) -> None:
    if case.filmed:
        film_capture(folder, case, truth, overwrite=True)
    else:
        make_capture(folder, case, truth, overwrite=True)


def main() -> int:
    """Print one name a line; with `make`, write OUT/<name with / as __> and OUT.truth/<the same>.json for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("list", "make"))
    parser.add_argument("out", nargs="?", type=Path)
    parser.add_argument("--stage", choices=STAGES, default="development")
    parser.add_argument("--only", default="", help="part of the name")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--list", choices=(*LISTS, "video"), default="all", dest="which")
    words = parser.parse_args()
    if words.what == "make" and words.out is None:
        parser.error("where to? name a directory: make OUT")
    every = filmed_cases(words.stage) if words.which == "video" else LISTS[words.which](words.stage, words.repeats)
    for case in every:
        if words.only not in case.name:
            continue
        if words.what == "make":
            name, secret = case.name.replace("/", "__"), words.out.with_name(f"{words.out.name}.truth")
            secret.mkdir(parents=True, exist_ok=True)
            _make(words.out / name, case, secret / f"{name}.json")
        print(case.name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
