"""The page of the engine table, the chart of the error budget, and the draft of a capture's motions."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))  # as `python benchmarks/engine_page.py` has it
try:
    import budget_page
    import engine_page
    import few_photos
    from tabletop.draft import Draft
finally:
    sys.path.remove(str(BENCHMARKS))

ROW = {"task": "fall", "object": "box", "material": "wood", "engine": "rapier", "seed": 500, "device": "cuda"}


def row(name: str, seed: int, errors_mm: list[float], commit: str = "abc") -> dict:
    """A stored result with these errors."""
    episodes = [
        {"translation_mm": one, "rotation_deg": 2.0, "psnr_object_db": 17.123, "psnr_db": 20} for one in errors_mm
    ]
    fit = {"seconds": 3.0, "parameters": {"friction": 0.44, "x": 1}, "intervals_95": {"friction": [0.3, 0.5]}}
    more = {"row": name, "commit": commit, "key": f"{name}/{seed}", "fit": fit, "episodes": episodes, "seed": seed}
    return ROW | more | {"parameter_errors": {"friction": 0.1}, "wall_s": 4}


def test_the_page_is_that_of_the_stored_rows() -> None:
    stored = engine_page.page(engine_page.read(engine_page.STORED))
    assert engine_page.PAGE.read_text(encoding="utf-8") == stored


def test_the_budget_is_that_of_the_stored_rows() -> None:
    rows = [budget_page.json.loads(line) for line in budget_page.STORED.read_text(encoding="utf-8").splitlines()]
    assert budget_page.table(rows) in (budget_page.CHART.parent / "error-budget.md").read_text(encoding="utf-8")
    assert budget_page.CHART.read_text(encoding="utf-8") == budget_page.chart(rows)


def test_a_true_part_changes_what_it_changes() -> None:
    errors = [{"fitted": [[10.0, 2.0], [12.0, 4.0]], "shape": [[7.0, 5.0], [9.0, 7.0 + k]]} for k in range(3)]
    assert budget_page.change([{"errors": one} for one in errors], "shape", 0) == (-3.0, -3.0, -3.0)
    assert budget_page.change([{"errors": one} for one in errors], "shape", 1) == (3.5, 3.0, 4.0)


def test_rows_are_reduced_and_replaced(tmp_path: Path) -> None:
    store, rows = tmp_path / "store.jsonl", tmp_path / "rows.jsonl"
    for errors in ([50.0], [10.0, 30.0]):
        store.write_text(engine_page.json.dumps(row("cgwm", 500, errors)) + "\n", encoding="utf-8")
        assert engine_page.take([store], rows) == 1
    (kept,) = engine_page.read(rows)
    assert [one["translation_mm"] for one in kept["episodes"]] == [10.0, 30.0]
    assert "wall_s" not in kept and kept["fit"]["parameters"] == {"friction": 0.44}


def test_the_page_pairs_captures() -> None:
    rows = [row("cgwm", k, [10.0 + k]) for k in (500, 501, 502)] + [row("floor", k, [8.0 + k]) for k in (500, 501)]
    text = engine_page.page([engine_page.reduced(one) for one in rows])
    assert "| cgwm | 3 | 511.0 / 2.0 (511.0 / 2.0) | 17.12 | 10 | 3 of 3 | 3 |" in text
    assert "-2.0 (-2.0 to -2.0)" in text and "| fall | 2 | 1.00 | 1.00 | +0.00 |" in text
    assert "| fall | rapier | 3 | 3 | box wood, box wood (seed 501), box wood (seed 502) |" in text
    assert "| floor | 2 of 3 | fall rapier: box wood |" in text


def test_engines_count_alike_whatever_their_captures() -> None:
    rows = [row("cgwm", k, [10.0 + k]) for k in (500, 501, 502)]
    rows += [row("cgwm", 500, [100.0]) | {"engine": engine, "key": engine} for engine in ("dart", "mujoco")]
    text = engine_page.page([engine_page.reduced(one) for one in rows])
    assert "| cgwm | 3 | 5 | 100.0, 237.0 | 2.0, 2.0 | 17.12, 17.12 | 10, 10 |" in text


def test_a_later_report_stands_alone() -> None:
    rows = [row("cgwm", 500, [10.0]), row("floor", 500, [10.0])]
    rows += [row("cgwm", 600, [30.0], "def1234567"), row("floor", 600, [20.0], "def1234567")]
    text = engine_page.page([engine_page.reduced(one) for one in rows])
    first, later = text.split("## Fresh captures")
    assert "| fall | 1 | 1.00 | 1.00 | +0.00 |" in first and "30.0" not in first.split("## Over seeds")[0]
    assert "(seed 600), at `def1234`" in later and "| all three | 1 | 1.50 | 1.00 | +0.00 |" in later
    assert "Captures: fall box wood rapier." in later
    assert "| 600, `def1234` | fall | 1 | 1.50 | 1.00 | +0.00 | 10 | 1 of 1 (100 %) |" in first
    rows += [row("cgwm", 700, [20.0]), row("floor", 700, [10.0]), row("cgwm, later code", 500, [5.0], "fed7654321")]
    text = engine_page.page([engine_page.reduced(one) for one in rows])
    over, newest, older = text.partition("## Over seeds")[2].split("\n## ")[:3]
    assert newest.startswith("Fresh captures\n\nCaptures of which nothing was seen before (seed 700)")
    assert older.startswith("An earlier report, seed 600")
    assert (
        "| 500, again, `fed7654` | all three | 1 | 0.50 |" in over and "| all, as reported | fall | 3 | 2.00 |" in over
    )


def test_a_draft_goes_on_where_it_stopped(tmp_path: Path) -> None:
    draft, rng, rejected = Draft(tmp_path / "drafts" / "one.json"), np.random.default_rng(3), {"chaotic": 2}
    beginnings = [rng.standard_normal(13)]
    draft.write(rng, rejected, beginnings)
    other, empty = np.random.default_rng(9), {"chaotic": 0}
    (known,) = draft.read(other, empty)
    assert np.array_equal(known, beginnings[0]) and empty == rejected
    assert np.array_equal(other.standard_normal(5), rng.standard_normal(5))
    assert Draft().read(other, empty) == []


def test_the_gain_with_few_photos_is_paired_by_capture() -> None:
    def measured(photos: str, two: float, joint: float) -> dict[str, object]:
        values = {"two stages": two, "joint": joint, "floor": 20.0}
        rows = {
            name: {"psnr_object_db": [[v, None], [v, v + 2]], "translation_mm": [v], "rotation_deg": [v]}
            for name, v in values.items()
        }
        return {"photos": photos, "rows": rows}

    stored = [measured("4 photos", 15.0, 16.0), measured("4 photos", 11.0, 12.0), measured("8 photos", 11.0, 12.0)]
    assert few_photos.curves(stored, "4 photos")["joint"] == [
        14.0,
        16.0,
    ]  # a frame that one motion lacks is the others'
    assert few_photos.gain(stored, "4 photos", "psnr_object_db", "joint", "two stages") == (1.0, 1.0, 1.0)
    assert few_photos.gain(stored, "8 photos", "translation_mm", "two stages", "floor") == (-9.0, -9.0, -9.0)
    assert few_photos.chart(stored).count("<polyline points") == 2 * 3 + 3  # and the legend
    assert few_photos.table(stored).count("\n") == 3
    assert few_photos.published_table(stored).count("\n") == 1  # none of them has its rows
    stored[0]["rows"] |= {"as published": measured("", 20.0, 0.0)["rows"]["two stages"]}
    stored[0]["rows"] |= {"paper's law, two stages": stored[1]["rows"]["joint"]}
    (line,) = few_photos.published_table(stored).splitlines()[2:]
    assert line.startswith("| 4 photos | 1 | 16.00 | 13.00 | 21.00 | +8.00 (+8.00 to +8.00) | +8.00")


def test_photos_are_left_out_evenly_with_their_cameras(tmp_path: Path) -> None:
    whole, kept = tmp_path / "capture", tmp_path / "few"
    for folder in ("images", "masks"):
        (whole / folder).mkdir(parents=True)
    names = [f"{k:03d}.jpg" for k in range(10)]
    for name in names:
        (whole / "images" / name).touch()
        (whole / "masks" / name.replace("jpg", "png")).touch()
    (whole / "cameras.json").write_text(json.dumps({"images": {key: {} for key in names}, "videos": {"left": {}}}))
    chosen = ["000.jpg", "003.jpg", "006.jpg", "009.jpg"]
    assert few_photos.keep_photos(whole, kept, 4) == chosen
    assert sorted(path.name for path in (kept / "images").iterdir()) == chosen
    assert len(list((kept / "masks").iterdir())) == 4
    assert json.loads((kept / "cameras.json").read_text()) == {
        "images": {key: {} for key in chosen},
        "videos": {"left": {}},
    }
    assert len(json.loads((whole / "cameras.json").read_text())["images"]) == 10
