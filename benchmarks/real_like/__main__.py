"""List the real-like cases of a stage, or make their captures; see `real_like`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from . import EACH, NULLS, STAGES, make_real_capture, missing, real_cases


def main() -> int:
    """Print one name a line; with `make`, write OUT/<name with / as __> and OUT.truth/<the same>.json for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("list", "make"))
    parser.add_argument("out", nargs="?", type=Path)
    parser.add_argument("--stage", choices=STAGES, default="development")
    parser.add_argument("--only", default="", help="part of the name")
    parser.add_argument("--nulls", type=int, default=NULLS, help="for each engine")
    parser.add_argument("--each", type=int, default=EACH, help="captures of each other row")
    words = parser.parse_args()
    if words.what == "make" and words.out is None:
        parser.error("where to? name a directory: make OUT")
    left_out = 0
    for case in real_cases(words.stage, words.nulls, words.each):
        if words.only not in case.name:
            continue
        lacking = missing(case.group)
        if lacking and words.what == "make":
            left_out += 1
            print(f"{case.name}: not made, {lacking} is not installed", file=sys.stderr)
            continue
        if words.what == "make":
            name, secret = case.name.replace("/", "__"), words.out.with_name(f"{words.out.name}.truth")
            capture, truth = words.out / name, secret / f"{name}.json"
            if not (capture.is_dir() and truth.is_file()):
                secret.mkdir(parents=True, exist_ok=True)
                make_real_capture(capture, case, truth, overwrite=True)
        print(case.name, flush=True)
    return 1 if left_out else 0


if __name__ == "__main__":
    sys.exit(main())
