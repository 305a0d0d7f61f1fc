"""Write the thresholds of a diagnosis into docs/thresholds.md: `python benchmarks/thresholds_page.py`.

The tables between the comments `<!-- thresholds: GROUP -->` and `<!-- end -->` are replaced by those of
`thresholds.py` in `pipeline/diagnose/`, `pipeline/segments/` and `pipeline/trajectories/`; the rest of the page is
left as it is.
"""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import fields
from pathlib import Path

from cgwm.pipeline.diagnose.thresholds import THRESHOLDS
from cgwm.pipeline.segments.thresholds import SEGMENT_THRESHOLDS
from cgwm.pipeline.trajectories.thresholds import TRACK_THRESHOLDS, Threshold, thresholds_of

PAGE = Path(__file__).resolve().parents[1] / "docs" / "thresholds.md"
HEAD = ("name", "value", "unit", "decides", "calibrated on", "false alarms and misses")


def groups() -> dict[str, list[Threshold]]:
    """Return the thresholds of each group."""
    return {
        one.name: thresholds_of(getattr(every, one.name))
        for every in (THRESHOLDS, SEGMENT_THRESHOLDS, TRACK_THRESHOLDS)
        for one in fields(every)
    }


def table(group: str, thresholds: list[Threshold]) -> str:
    """Return the table of a group, in Markdown."""
    rows = [HEAD, ("---",) * len(HEAD)]
    for one in thresholds:
        value = f"{one.value:.4g}" if isinstance(one.value, float) else str(one.value)
        rows.append((f"`{group}.{one.name}`", f"`{value}`", one.unit, one.decides, one.calibrated_on, one.error_rates))
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def page(text: str) -> str:
    """Return the page with all tables written anew.

    Raises:
        ValueError: If the page has no place for a group.
    """
    for group, thresholds in groups().items():
        begin, end = f"<!-- thresholds: {group} -->\n\n", "\n\n<!-- end -->"
        if begin not in text:
            raise ValueError(f"{PAGE.name} has no line {begin.strip()}")
        before, _, rest = text.partition(begin)
        text = f"{before}{begin}{table(group, thresholds)}{end}{rest.partition(end)[2]}"
    return text


def main() -> int:
    """Write the page."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    count = len(re.findall("<!-- thresholds:", PAGE.read_text(encoding="utf-8")))
    print(f"{PAGE}: {count} tables written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
