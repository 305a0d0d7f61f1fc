"""Run the fuzzer at length: `PYTHONPATH=tests python -m fuzz --cases 1000 --seed 1 --failures out/fuzz`."""

from __future__ import annotations

import argparse
import itertools
import random
import re
import shutil
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.strategies import SearchStrategy

from .cases import Case, Trial, Verdict, cases
from .client import Runner
from .subjects import SUBJECTS, Library
from .tables import judged, must_accept, must_refuse


def main() -> None:
    """Parse the options, run, print the counts, and end with 1 if there were faults."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--subjects", default="", help="comma-separated names or kinds (default: all)")
    parser.add_argument("--seconds", type=float, default=0.0, help="stop after this time")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds that a command may take")
    parser.add_argument("--failures", type=Path, default=Path("out/fuzz"), help="folder for the cases that failed")
    parser.add_argument("--table", choices=["refuse", "accept"], help="run a table instead of random cases")
    parser.add_argument("--only", default="", help="lines of the table that have this text in their name")
    parser.add_argument("--again", type=Path, help="run one case of that folder again, and keep its inputs")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="cgwm-fuzz-") as folder:
        root = Path(folder)
        library = Library(root / "library")
        with Runner(root / "home", options.limit) as runner:
            if options.again:
                _again(Case.of(options.again.read_text()), Trial(Path(tempfile.mkdtemp()), runner, library))
                return
            trial = Trial(root / "cases", runner, library)
            if options.table:
                sys.exit(table(trial, options.table == "refuse", options.only))
            verdicts = survey(trial, options.cases, options.seed, chosen(options.subjects), seconds=options.seconds)
    sys.exit(report(verdicts, options.failures))


def chosen(text: str) -> tuple[str, ...]:
    """Return the names of subjects that are named, or whose kind is."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    return tuple(s.name for s in SUBJECTS.values() if s.weight and (s.name in names or s.kind in names))


class _Done(BaseException):
    """Ends a survey; no Exception, which hypothesis would take for a failure of the case."""


CHUNK = 12
"""Cases that hypothesis draws in a row: it varies what it has drawn before, so that many in a row are much alike."""


def survey(
    trial: Trial,
    count: int,
    number: int,
    subjects: tuple[str, ...] = (),
    verbs: tuple[str, ...] = (),
    seconds: float = 0.0,
) -> list[Verdict]:
    """Run cases and return how all of them went; without stopping at a failure."""
    found: list[Verdict] = []
    began = time.monotonic()
    alike: Counter[str] = Counter()

    def full() -> bool:
        return len(found) >= count or bool(seconds and time.monotonic() - began > seconds)

    for chunk in itertools.count(1):
        if full():
            return found
        for case in _drawn(cases(trial.library, subjects, verbs), 1_000_003 * number + chunk):
            place = _place(case)
            alike[place] += 1
            if alike[place] > 2 or full():
                continue
            verdict = trial.run(case)
            found.append(verdict)
            if verdict.faults:
                print(f"{len(found):5d} {verdict.seen.seconds:6.1f} s  {verdict.faults}\n      {case}", flush=True)
    raise AssertionError


def _drawn(strategy: SearchStrategy[Case], number: int) -> list[Case]:
    """Draw a few cases from a seed."""
    drawn: list[Case] = []

    @seed(number)
    @settings(**_QUIETLY)
    @given(case=strategy)
    def draw(case: Case) -> None:
        drawn.append(case)

    draw()
    return drawn[1:]  # the first is always the simplest


_QUIETLY: dict[str, Any] = {
    "max_examples": CHUNK,
    "database": None,
    "deadline": None,
    "phases": [Phase.generate],
    "suppress_health_check": list(HealthCheck),
}


def _place(case: Case) -> str:
    """Return where a case changes what, without the value: what was tried there teaches little more."""
    names = ("file", "op", "what", "to", "do", "column")
    places = [{key: change.get(key) for key in names} for change in case.changes]
    at = [change["at"] for change in case.changes if isinstance(change.get("at"), list | str)]
    return f"{case.subject} {case.words} {places} {at}"


def report(verdicts: list[Verdict], folder: Path) -> int:
    """Print the counts by kind of input and by class of fault, and keep the cases that failed."""
    print(f"\n{len(verdicts)} cases, {sum(v.seen.seconds for v in verdicts):.0f} s of commands")
    by_kind: dict[str, list[Verdict]] = defaultdict(list)
    for verdict in verdicts:
        by_kind[SUBJECTS[verdict.case.subject].kind].append(verdict)
    for kind, group in sorted(by_kind.items()):
        codes = Counter(v.seen.code for v in group)
        good = sum(not v.faults for v in group)
        print(f"  {kind:12s} {len(group):5d} cases, {good:5d} as promised, codes {dict(codes)}")
    classes = Counter(kind for v in verdicts for kind in {kind for kind, _ in v.faults})
    for kind, count in classes.most_common():
        print(f"  {count:5d} {kind}")
    groups: dict[tuple[str, str], list[Verdict]] = defaultdict(list)
    for verdict in verdicts:
        for kind, detail in verdict.faults:
            groups[kind, signature(detail)].append(verdict)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    print(f"\n{len(groups)} distinct:")
    for k, ((kind, text), group) in enumerate(sorted(groups.items(), key=lambda item: -len(item[1]))):
        path = folder / f"{k:03d}-{re.sub(r'[^a-z]+', '-', kind)}.json"
        path.write_text(group[0].case.json())
        print(f"  {len(group):4d} {kind}: {text[:200]!r}\n       {path}: {group[0].case}")
    return int(bool(classes))


def signature(detail: str) -> str:
    """Return a message without what differs from case to case."""
    detail = re.sub(r"/tmp/\S+?/in/", "", detail)
    return re.sub(r"'[^']*'|\"[^\"]*\"|-?\d[\d.e+-]*", "#", detail)[:160]


def table(trial: Trial, refuse: bool, only: str) -> int:
    """Run a table, print each line that is not as it has to be, and the counts by kind."""
    rows = [row for row in (must_refuse() if refuse else must_accept()) if only in row.name or only == row.kind]
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for row in rows:
        began = time.monotonic()
        try:
            seen, found = judged(trial, row, refuse)
        except Exception as error:
            print(f"BROKEN [{row.kind}] {row.name}: {type(error).__name__}: {error}", flush=True)
            counts[row.kind]["broken"] += 1
            continue
        counts[row.kind]["lines"] += 1
        counts[row.kind].update({kind for kind, _ in found} or {"as promised"})
        if found:
            took = time.monotonic() - began
            print(f"[{row.kind}] {row.name}  ({seen.code}, {took:.1f} s)\n      {found}", flush=True)
    for kind, count in counts.items():
        print(f"{kind:10s} {dict(count.most_common())}")
    total = sum(counts.values(), Counter())
    print(f"all        {dict(total.most_common())}")
    return int(total["as promised"] < total["lines"])


def _again(case: Case, trial: Trial) -> None:
    print(case)
    verdict = trial.run(case, keep=True)
    print(f"exit code {verdict.seen.code} after {verdict.seen.seconds} s, {verdict.seen.peak_mb} MB")
    print(f"--- stderr\n{verdict.seen.stderr}\n--- stdout\n{verdict.seen.stdout[:3000]}\n--- faults")
    for kind, detail in verdict.faults:
        print(f"{kind}: {detail}")
    print(f"The inputs are in {trial.folder}/case-1/in")


if __name__ == "__main__":
    random.seed(0)
    main()
