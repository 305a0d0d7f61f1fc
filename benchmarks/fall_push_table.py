"""The table of the benchmark `fall_push.py`, in Markdown, from stored results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

COLUMNS = (("translation_mm", 1), ("rotation_deg", 1), ("psnr_db", 2), ("psnr_object_db", 2))
"""Errors of an episode, and their decimals."""
_HEADER = (
    "| row | trans mm | rot ° | PSNR dB | object PSNR dB | fit s | friction error % | cells | failed |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


def table(results: Sequence[dict[str, Any]], names: dict[str, Sequence[str]], seed: int) -> str:
    """Return a table for each task and object, and one over all objects, with a caption that says what they show.

    Args:
        results: Stored results.
        names: The tasks, objects, materials and rows to show.
        seed: Of the results to show.
    """
    chosen = [
        row
        for row in results
        if row.get("seed") == seed
        and "not_run" not in row
        and row.get("engine", "mujoco") in names["engines"]
        and all(row.get(one) in names[f"{one}s"] for one in ("task", "object", "material", "row"))
    ]
    if not chosen:
        return "No results yet."
    parts = []
    for device in sorted({row["device"] for row in chosen}):
        here = [row for row in chosen if row["device"] == device]
        parts.append(_caption(here, device, seed))
        for task in names["tasks"]:
            for obj in names["objects"]:
                parts += _section(f"{task}, {obj}", [r for r in here if (r["task"], r["object"]) == (task, obj)], names)
            if len(names["objects"]) > 1:
                parts += _section(f"{task}, all objects", [r for r in here if r["task"] == task], names)
    return "\n\n".join(parts)


def _caption(results: Sequence[dict[str, Any]], device: str, seed: int) -> str:
    frames = sorted({row["psnr_every"] for row in results})
    looked = " or ".join({0: "no frame", 1: "every frame"}.get(n, f"every {n}th frame") for n in frames)
    commits = ", ".join(sorted({row["commit"] or "unknown" for row in results}))
    dates = sorted({row["date"] for row in results})
    return (
        f"Medians (means in brackets) over the test episodes of all materials, open loop from the true state at the "
        f"first frame; seed {seed}, device {device}, commit {commits}, {dates[0]} to {dates[-1]}. PSNR of {looked}, "
        f"renders of the predicted poses with the same splats. Fit: median seconds of wall time, as many at a time as "
        f"the run had workers. Friction: mean of the cells' absolute errors. Cells: those fitted, of all. Failed: "
        f"episodes whose prediction diverged, in fitted cells."
    )


def _section(title: str, results: Sequence[dict[str, Any]], names: dict[str, Sequence[str]]) -> list[str]:
    by_row = {name: [row for row in results if row["row"] == name] for name in names["rows"]}
    lines = [_line(name, rows) for name, rows in by_row.items() if rows]
    reasons = [
        f"Failed: {row['row']}, {row['object']}, {row['material']}: {row['failed']}"
        for row in results
        if "failed" in row
    ]
    return ["\n".join((f"**{title}**\n", _HEADER, *lines)), *reasons] if lines else []


def _line(name: str, rows: Sequence[dict[str, Any]]) -> str:
    fitted = [row for row in rows if "failed" not in row]
    episodes = [episode for row in fitted for episode in row["episodes"]]
    good = [episode for episode in episodes if "failed" not in episode]
    cells = [_both([e[key] for e in good if key in e], decimals) for key, decimals in COLUMNS]
    seconds = [row["fit"]["seconds"] for row in fitted]
    friction = [abs(row["parameter_errors"]["friction"]) for row in fitted if "friction" in row["parameter_errors"]]
    cells.append(f"{np.median(seconds):.0f}" if seconds else "failed")
    cells.append(f"{100 * np.mean(friction):.1f}" if friction else "–")
    cells += [f"{len(fitted)}/{len(rows)}", f"{len(episodes) - len(good)}/{len(episodes)}"]
    return f"| {name} | " + " | ".join(cells) + " |"


def _both(values: Sequence[float], decimals: int) -> str:
    """Return median and mean."""
    known = [value for value in values if np.isfinite(value)]
    return f"{np.median(known):.{decimals}f} ({np.mean(known):.{decimals}f})" if known else "–"
