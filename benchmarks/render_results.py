"""Record a figure in benchmarks/results/, or render all of them as pages of docs/ (`make results`).

    python benchmarks/render_results.py       # writes docs/results.md and its pages docs/results-PAGE.md
    python benchmarks/render_results.py record tests --figure "CUDA tests passed" --value "73 of 73" --target all
        --met yes --command "pytest tests/pipeline/physics/fused/test_fused.py" --machine "H100, 16 cores"

Each claim is a file CLAIM.jsonl with one line for each figure; `results/claims.toml` gives their order, titles,
explanations and pages. A figure stays valid until it is measured again: `record` then replaces the line of the same
name and stamps it with the commit and the date. Lines marked `transcribed` were taken once from an older journal,
`measured` ones were written by `record`. Needs nothing but Python's standard library and git.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import sys
import tomllib
from dataclasses import asdict, dataclass, fields
from datetime import date
from pathlib import Path
from typing import Any

from store import ROOT, commit_of_tree

RESULTS = ROOT / "benchmarks" / "results"
DOCS = ROOT / "docs"
MOST_LINES = 150
"""Length of a page that a reader still looks through."""
STATUSES = ("transcribed", "measured")
_COMMIT = re.compile(r"[0-9a-f]{7,40}\+?")


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One line of a claim's file."""

    figure: str
    """What is measured, in words; unique within the claim."""
    value: float | str
    unit: str
    """Of the value; empty where the value says it."""
    target: str
    """In words, in the unit of the value; empty where none was set."""
    met: bool | None
    """Whether the value meets the target; None without a target, or where the value cannot decide it."""
    command: str
    """What measures it, from the root of the repository."""
    commit: str
    """The commit that was measured; with a + where files differed from it."""
    machine: str
    date: str
    note: str
    """What a reader must know to understand the value; may be empty."""
    status: str
    """`transcribed` or `measured`."""

    def __post_init__(self) -> None:
        texts = {f.name for f in fields(self)} - {"value", "met"}
        wrong = [name for name in sorted(texts) if not isinstance(getattr(self, name), str)]
        wrong += [name for name in ("figure", "command", "machine") if not getattr(self, name)]
        wrong += ["value"] if isinstance(self.value, bool) or not isinstance(self.value, (int, float, str)) else []
        wrong += [] if self.met is None or (isinstance(self.met, bool) and self.target) else ["met"]
        wrong += [] if _COMMIT.fullmatch(self.commit) else ["commit"]
        wrong += [] if self.status in STATUSES else ["status"]
        date.fromisoformat(self.date)
        if wrong:
            raise ValueError(f"the figure '{self.figure}' has no valid {', '.join(wrong)}.")


def read_claims(folder: Path = RESULTS) -> list[dict[str, Any]]:
    """Return the claims of `claims.toml` in their order, each with its `figures`.

    Raises:
        ValueError: If a line does not match the schema, a figure is there twice, or claims and files differ.
    """
    claims = tomllib.loads((folder / "claims.toml").read_text(encoding="utf-8"))["claim"]
    named, there = {claim["name"] for claim in claims}, {path.stem for path in folder.glob("*.jsonl")}
    if named != there:
        raise ValueError(f"claims.toml and the files *.jsonl differ: {', '.join(sorted(named ^ there))}.")
    return [claim | {"figures": read_figures(folder / f"{claim['name']}.jsonl")} for claim in claims]


def read_figures(path: Path) -> list[Figure]:
    """Return the figures of one claim, in the order of the file."""
    found = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            found.append(Figure(**json.loads(line)))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path.name}, line {number}: {error}") from error
    names = [one.figure for one in found]
    if len(set(names)) < len(names):
        raise ValueError(f"{path.name} has a figure twice.")
    return found


def record(
    claim: str,
    figure: str,
    value: float | str,
    *,
    command: str,
    unit: str = "",
    target: str = "",
    met: bool | None = None,
    note: str = "",
    machine: str = "",
    folder: Path = RESULTS,
) -> Figure:
    """Replace the line of a figure by a new measurement, or append it; stamp commit, machine and date.

    Args:
        claim: Name of the file in `folder`; one that is new needs an entry in claims.toml, too.
        figure: What is measured, exactly as the line to be replaced has it.
        value: The measurement.
        command: What measured it, from the root of the repository.
        unit: Of the value.
        target: In words.
        met: Whether the target is met; None without one.
        note: What a reader must know.
        machine: In words, `$CGWM_MACHINE` or the number of cores where left out.
        folder: Of the claims.
    """
    machine = machine or os.environ.get("CGWM_MACHINE") or f"{os.cpu_count()} cores ({platform.machine()})"
    new = Figure(
        figure=figure,
        value=value,
        unit=unit,
        target=target,
        met=met,
        command=command,
        commit=commit_of_tree(),
        machine=machine,
        date=date.today().isoformat(),
        note=note,
        status="measured",
    )
    path = folder / f"{claim}.jsonl"
    old = read_figures(path) if path.is_file() else []
    names = [one.figure for one in old]
    kept = [new if one.figure == figure else one for one in old] + ([] if figure in names else [new])
    lines = [json.dumps(asdict(one), ensure_ascii=False) + "\n" for one in kept]
    path.write_text("".join(lines), encoding="utf-8")
    return new


def render(folder: Path = RESULTS) -> dict[str, str]:
    """Return the pages by file name: a summary of the most asked questions, and one page for each subject."""
    claims = read_claims(folder)
    subjects = tomllib.loads((folder / "claims.toml").read_text(encoding="utf-8"))["page"]
    every = [one for claim in claims for one in claim["figures"]]
    counts = {met: sum(one.met is met for one in every) for met in (True, False, None)}
    lines = [
        "# Results",
        "",
        f"Of {len(every)} figures {counts[True]} meet their target, {counts[False]} miss it, {counts[None]} have no "
        "target or leave it undecided (*open*). The most asked ones are below; all of them, with command, commit and "
        "machine:",
        "",
    ]
    pages = {}
    for subject in subjects:
        own = [claim for claim in claims if claim["page"] == subject["name"]]
        links = ", ".join(f"[{claim['title']}]({_place(claim)})" for claim in own)
        lines.append(f"- {subject['about']} {links}.")
        pages[f"results-{subject['name']}.md"] = _page(subject, own)
    lines += ["", "| claim | figure | today | target | |", "| --- | --- | --- | --- | --- |"]
    for claim in claims:
        known = {one.figure: one for one in claim["figures"]}
        for one in (known[name] for name in claim.get("headline", ())):
            title = f"[{claim['title']}]({_place(claim)})"
            lines.append(_row(title, one.figure, f"**{_value(one)}**", one.target, _verdict(one)))
    return {"results.md": "\n".join(lines) + "\n", **pages}


def _page(subject: dict[str, Any], claims: list[dict[str, Any]]) -> str:
    """Return the page of one subject: a table for each claim."""
    lines = [
        f"# {subject['title']}",
        "",
        f"{subject['about']} Written by `make results` from `benchmarks/results/*.jsonl`; a figure stays valid until "
        "it is measured again. A date in brackets marks a figure that was transcribed from an older journal (with the "
        "commit that entered it where the journal named none). The summary of all pages: [Results](results.md).",
    ]
    for claim in claims:
        lines += ["", f"## {claim['title']}", "", *([claim["about"], ""] if "about" in claim else [])]
        lines += _table(claim["figures"])
    return "\n".join(lines) + "\n"


def _table(figures: list[Figure]) -> list[str]:
    """Return a table of figures, then what a reader must know of some of them, then the runs that measured them."""
    runs: dict[str, int] = {}
    rows, notes = [], []
    for number, one in enumerate(figures, 1):
        run = runs.setdefault(_run(one), len(runs) + 1)
        rows.append(_row(str(number), one.figure, _value(one), one.target, _verdict(one), f"R{run}"))
        notes += [f"- {number}: {one.note.rstrip('.')}."] if one.note else []
    lines = ["| | figure | value | target | | run |", "| --- " * 6 + "|", *rows]
    lines += ["", "To these figures:", "", *notes] if notes else []
    return [*lines, "", "Runs:", "", *(f"- R{run}: {text}" for text, run in runs.items())]


def _run(one: Figure) -> str:
    """Return what measured a figure: command, commit, date and machine."""
    day = f"({one.date})" if one.status == "transcribed" else one.date
    return f"`{one.command}`, at `{one.commit}` {day}, {one.machine}."


def _place(claim: dict[str, Any]) -> str:
    """Return the link to a claim's table."""
    return f"results-{claim['page']}.md#{_anchor(claim['title'])}"


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _value(one: Figure) -> str:
    return f"{one.value} {one.unit}".strip()


def _verdict(one: Figure) -> str:
    if one.met is None:
        return "open" if one.target else ""
    return "met" if one.met else "**missed**"


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z0-9 -]", "", title.lower()).replace(" ", "-")


def main(words: list[str] | None = None) -> int:
    """Render the pages, or record one figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    adding = parser.add_subparsers(dest="verb").add_parser("record", help="replace or add the line of one figure")
    adding.add_argument("claim")
    adding.add_argument("--figure", required=True)
    adding.add_argument("--value", required=True)
    adding.add_argument("--command", required=True)
    adding.add_argument("--unit", default="")
    adding.add_argument("--target", default="")
    adding.add_argument("--met", choices=("yes", "no"), help="left out without a target")
    adding.add_argument("--note", default="")
    adding.add_argument("--machine", default="")
    given = parser.parse_args(words)
    if given.verb == "record":
        options = {key: value for key, value in vars(given).items() if key not in ("verb", "met")}
        print(json.dumps(asdict(record(**options, met=None if given.met is None else given.met == "yes"))))
    pages = render()
    long = {name: text.count("\n") for name, text in pages.items() if text.count("\n") > MOST_LINES}
    if long:
        print(f"at most {MOST_LINES} lines: {long}.", file=sys.stderr)
        return 1
    for name, text in pages.items():
        (DOCS / name).write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
