"""Object PSNR over the horizon: geometry refined jointly with the motion against two stages, with few photos.

    python benchmarks/few_photos.py run --seed 140 --tasks fall,push,tip --engines rapier [--device cuda] [--workers 4]
    python benchmarks/few_photos.py page     # the table, and the chart docs/few-photos.svg, from the stored rows

Captures are those of `fall_push.py` with fewer test motions, of which every fourth frame is drawn. Of the 48 photos 4,
8 or 20 are kept, evenly spread; *wrong shape* has 20, and contact spheres that are enlarged by a tenth about their
middle. From the same spheres of stage sg-gs come the default fit (*two stages*), the fit with
`phys-geo.geometry=true` (*joint*), and the floor: our law with all that is true; then the published setting,
`phys-geo.contact_law=paper`, which refines geometry (*as published*), and the same without that (*paper's law, two
stages*). All are rendered with these spheres.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast
from xml.sax.saxutils import escape

import numpy as np
from cgwm.datasets.models.model import read_model, write_model
from cgwm.datasets.shapes.ply import Splats
from cgwm.pipeline.demo.truth_tables import OBJECT
from cgwm.pipeline.evaluate.prediction import MODEL
from cgwm.pipeline.fit import fit
from cgwm.pipeline.rendering.video_view import usable_cameras
from cgwm.schemas import CgwmError, SplatConfig
from contenders.base import Cell, Fitted
from contenders.cgwm_default import Cgwm
from contenders.floor import Floor
from fall_push_engines import bootstrap_interval
from scoring import Judge, _as_prediction, pose_errors
from steps import Step, run_steps
from store import ROOT, Store, timed
from tabletop.capture import Task
from tabletop.draft import Draft
from tabletop.jobs import CaptureJob

STORED, CHART = ROOT / "benchmarks" / "few_photos_rows.jsonl", ROOT / "docs" / "few-photos.svg"
EVERY, TESTS = 4, 6
"""Stride of the test frames that are looked at, and test motions of a capture."""
WRONG, ENLARGED = "wrong shape", 1.1
PHOTOS = {"4 photos": 4, "8 photos": 8, "20 photos": 20, WRONG: 20}
TWO, JOINT, FLOOR = "two stages", "joint", "floor"
ROWS = {TWO: Cgwm(), JOINT: Cgwm(JOINT, {"geometry": True}), FLOOR: Floor()}
PUBLISHED, PUBLISHED_TWO = "as published", "paper's law, two stages"
MORE = {
    PUBLISHED: Cgwm(PUBLISHED, {"contact_law": "paper"}),
    PUBLISHED_TWO: Cgwm(PUBLISHED_TWO, {"contact_law": "paper", "geometry": False}),
}
"""Rows of a table of their own, on the captures that have them."""


@dataclass(frozen=True)
class Job(CaptureJob):
    """One capture with some of its photos."""

    photos: str


def make_whole(job: Job, folder: Path) -> None:
    """Make the capture of a job with all its photos where there is none."""
    from tabletop import make_capture

    path = _whole(job, folder)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = Draft(folder / "drafts" / f"{path.name}.json")
        kind = cast(Task, job.task)
        make_capture(
            path, job.object, job.material, kind, job.seed, TESTS, engine=job.engine, tests_every=EVERY, draft=draft
        )


def make_scene(job: Job, folder: Path, device: str) -> None:
    """Fit the spheres of a job's object to its photos, where that was not done; the wrong shape begins from those."""
    reduced, scene = _reduced(job, folder), _scene(job, folder)
    if not reduced.exists():
        keep_photos(_whole(job, folder), reduced, PHOTOS[job.photos])
    if not scene.exists():
        config = SplatConfig(seed=job.seed, device=device)  # pyright: ignore[reportArgumentType]
        fit(reduced, scene, stage="sg-gs", splat_config=config)


def measure(job: Job, folder: Path, device: str) -> dict[str, Any]:
    """Fit a capture with some of its photos in two ways, and judge both and the floor: dB by motion and frame."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as temporary:
        scene = _scene(job, folder)
        if job.photos == WRONG:
            scene = _enlarged(scene, Path(temporary) / "wrong")
        cell = Cell(_reduced(job, folder), scene, device, job.seed)
        judge = Judge.of(cell, EVERY)
        for name, row in (ROWS | MORE).items():
            try:
                fitted = row.fit(cell, None)
            except CgwmError as error:
                return vars(job) | {"failed": f"{name}: {error.found}", "rows": found}
            motions = [(fitted.predict(one.start, one.drives, one.times_s), one) for one in judge.episodes]
            errors = [pose_errors(*motion) for motion in motions]
            found[name] = {
                "psnr_object_db": over_horizon(judge, fitted),
                "translation_mm": [round(one["translation_mm"], 2) for one in errors],
                "rotation_deg": [round(one["rotation_deg"], 2) for one in errors],
                "seconds": fitted.record["seconds"],
            }
    return vars(job) | {"rows": found}


def keep_photos(capture: Path, out: Path, count: int) -> list[str]:
    """Copy a capture with so many of its photos, evenly spread in their order, and return their names."""
    names = sorted(path.name for path in (capture / "images").iterdir())
    kept = [names[k] for k in np.unique(np.linspace(0, len(names) - 1, count).round().astype(int))]
    stems = {Path(name).stem for name in kept}
    shutil.copytree(capture, out, copy_function=os.link)
    for folder in ("images", "masks"):
        for path in (out / folder).iterdir():
            if path.stem not in stems:
                path.unlink()
    cameras = json.loads((capture / "cameras.json").read_text(encoding="utf-8"))
    cameras["images"] = {name: camera for name, camera in cameras["images"].items() if name in kept}
    (out / "cameras.json").unlink()  # a link to the capture's
    (out / "cameras.json").write_text(json.dumps(cameras), encoding="utf-8")
    return kept


def over_horizon(judge: Judge, fitted: Fitted) -> list[list[float | None]]:
    """Return the object PSNR of each test motion at each frame looked at [dB], the mean over cameras; None: unseen."""
    if judge.videos is None:
        raise ValueError("no videos are looked at")
    rows = []
    for episode in judge.episodes:
        row = _as_prediction(fitted.predict(episode.start, episode.drives, episode.times_s), episode)
        cameras = usable_cameras(judge.videos.capture, episode.name)[0]
        found = [judge.videos.compare(row, camera) for camera in cameras]
        values = np.array([one.psnr_object_db[MODEL] for one in found if one is not None])
        seen = np.isfinite(values)
        count = seen.sum(0)
        mean = np.where(seen, values, 0).sum(0) / np.maximum(count, 1)
        rows.append([round(float(v), 3) if n else None for v, n in zip(mean, count, strict=True)])
    return rows


def _whole(job: Job, folder: Path) -> Path:
    return folder / f"{job.object}_{job.material}_{job.task}_{job.engine}_{job.seed}"


def _reduced(job: Job, folder: Path) -> Path:
    return folder / f"{_whole(job, folder).name}_{PHOTOS[job.photos]}"


def _scene(job: Job, folder: Path) -> Path:
    return folder / "scenes" / _reduced(job, folder).name


def _enlarged(splats: Path, out: Path) -> Path:
    """Write a model whose object has larger contact spheres, farther apart, and return its directory."""
    model = read_model(splats)
    spheres = model.collision[OBJECT]
    middle = spheres.means.mean(0)
    larger = Splats(
        means=(middle + ENLARGED * (spheres.means - middle)).astype(np.float32),
        scales=(ENLARGED * spheres.scales).astype(np.float32),
        opacities=spheres.opacities,
        colors=spheres.colors,
    )
    write_model(out, replace(model, collision=model.collision | {OBJECT: larger}))
    return out


def curves(rows: Sequence[dict[str, Any]], photos: str) -> dict[str, list[float]]:
    """Return the mean object PSNR [dB] of each row of the chart by frame looked at: over motions, then captures."""
    whole = [row["rows"] for row in rows if row["photos"] == photos and _has(row, ROWS)]
    return {
        name: np.mean([_by_frame(one[name]["psnr_object_db"]) for one in whole], axis=0).tolist()
        for name in ROWS
        if whole
    }


def gain(rows: Sequence[dict[str, Any]], photos: str, key: str, first: str, second: str) -> tuple[float, float, float]:
    """Return how much the first row exceeds the second, the median over captures, with its 95 % interval.

    Args:
        rows: Stored rows.
        photos: One of `PHOTOS`.
        key: `psnr_object_db`, of which the mean over motions and frames counts, or an error, of which the median does.
        first: One of `ROWS` or `MORE`.
        second: Another.
    """
    whole = [row["rows"] for row in rows if row["photos"] == photos and _has(row, (*ROWS, first, second))]
    gaps = np.array([_middle(one[first], key) - _middle(one[second], key) for one in whole])
    return float(np.median(gaps)), *bootstrap_interval(gaps)


def _has(row: dict[str, Any], names: Iterable[str]) -> bool:
    """Return whether a stored result has all these rows."""
    return set(names) <= row["rows"].keys()


def _middle(one: dict[str, Any], key: str) -> float:
    return float(np.nanmean(_by_frame(one[key])) if key == "psnr_object_db" else np.median(one[key]))


def _by_frame(motions: Sequence[Sequence[float | None]]) -> np.ndarray:
    table = np.array([[np.nan if v is None else v for v in one] for one in motions], float)
    return np.nanmean(table, axis=0)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the gains in Markdown: joint over two stages, and two stages over the floor."""
    lines = ["| photos | captures | " + " | ".join(ROWS) + ", dB | joint over two stages: dB | mm | deg |"]
    lines.append("| --- " * (5 + len(ROWS)) + "|")
    for photos in PHOTOS:
        shown = curves(rows, photos)
        count = sum(row["photos"] == photos and _has(row, ROWS) for row in rows)
        if not shown:
            continue
        middles = [f"{np.mean(shown[name]):.2f}" for name in ROWS]
        gains = [
            "{:+.2f} ({:+.2f} to {:+.2f})".format(*gain(rows, photos, key, JOINT, TWO))
            for key in ("psnr_object_db", "translation_mm", "rotation_deg")
        ]
        lines.append(f"| {photos} | {count} | " + " | ".join([*middles, *gains]) + " |")
    return "\n".join(lines)


def published_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return in Markdown what the published setting gains over ours, and what joint refinement is worth in it."""
    names = (TWO, PUBLISHED_TWO, PUBLISHED)
    others = " | ".join(f"as published over {other}: dB | mm | deg" for other in ("its two stages", "ours"))
    lines = ["| photos | captures | " + " | ".join(names) + f", dB | {others} |", "| --- " * (8 + len(names)) + "|"]
    for photos in PHOTOS:
        here = [row for row in rows if row["photos"] == photos and _has(row, (*ROWS, *MORE))]
        if not here:
            continue
        middles = [f"{np.mean([_middle(row['rows'][name], 'psnr_object_db') for row in here]):.2f}" for name in names]
        gains = [
            "{:+.2f} ({:+.2f} to {:+.2f})".format(*gain(here, photos, key, PUBLISHED, other))
            for other in (PUBLISHED_TWO, TWO)
            for key in ("psnr_object_db", "translation_mm", "rotation_deg")
        ]
        lines.append(f"| {photos} | {len(here)} | " + " | ".join([*middles, *gains]) + " |")
    return "\n".join(lines)


_COLOURS = {TWO: "#4472a8", JOINT: "#b5543c", FLOOR: "#6b8e5a"}
_WIDE, _HIGH, _EDGE = 250, 190, 48


def chart(rows: Sequence[dict[str, Any]]) -> str:
    """Return the object PSNR over the frames as an SVG, a panel for each number of photos."""
    panels = {photos: shown for photos in PHOTOS if (shown := curves(rows, photos))}
    values = [v for shown in panels.values() for line in shown.values() for v in line]
    low, high = np.floor(min(values)), np.ceil(max(values))
    drawn = list[str]()
    for place, (photos, shown) in enumerate(panels.items()):
        left, top = _EDGE + place * (_WIDE + 30), 40
        drawn.append(f'<text x="{left + _WIDE / 2}" y="24" class="h" text-anchor="middle">{escape(photos)}</text>')
        drawn.append(f'<path class="axis" d="M{left} {top}v{_HIGH}h{_WIDE}"/>')
        for level in np.linspace(low, high, 4):
            y = top + _HIGH * (high - level) / (high - low)
            drawn.append(f'<text x="{left - 6}" y="{y + 4:.0f}" text-anchor="end">{level:.0f}</text>')
        drawn.append(f'<text x="{left}" y="{top + _HIGH + 18}">frame 1</text>')
        last = 1 + EVERY * (len(next(iter(shown.values()))) - 1)
        drawn.append(f'<text x="{left + _WIDE}" y="{top + _HIGH + 18}" text-anchor="end">frame {last}</text>')
        for name, line in shown.items():
            xs = left + _WIDE * np.arange(len(line)) / max(len(line) - 1, 1)
            ys = top + _HIGH * (high - np.array(line)) / (high - low)
            points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(xs, ys, strict=True))
            drawn.append(f'<polyline points="{points}" stroke="{_COLOURS[name]}"><title>{name}</title></polyline>')
    width = _EDGE + len(panels) * (_WIDE + 30)
    for place, name in enumerate(ROWS):
        x, y = _EDGE + 130 * place, _HIGH + 84
        drawn.append(f'<polyline points="{x},{y - 4} {x + 24},{y - 4}" stroke="{_COLOURS[name]}"/>')
        drawn.append(f'<text x="{x + 30}" y="{y}">{name}</text>')
    style = (
        "text{font:13px sans-serif;fill:#222}.h{font-weight:bold}.axis{stroke:#222;fill:none}"
        "polyline{fill:none;stroke-width:2}rect{fill:#fff}"
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {_HIGH + 96}" role="img">'
        f"<title>Object PSNR [dB] over the frames of a prediction</title><style>{style}</style>"
        f'<rect width="{width}" height="{_HIGH + 96}"/>' + "".join(drawn) + "</svg>\n"
    )


def _said(error: BaseException) -> None:
    print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)


def _timed(job: Job, folder: Path, device: str) -> dict[str, Any]:
    return timed(lambda: measure(job, folder, device))


def main() -> int:
    """Measure what is missing, or print the table and draw the chart."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "page"))
    parser.add_argument("--tasks", default="fall,push,tip")
    parser.add_argument("--objects", default="l_block,box")
    parser.add_argument("--materials", default="wood,rubber")
    parser.add_argument("--engines", default="rapier,dart")
    parser.add_argument("--photos", default=",".join(PHOTOS))
    parser.add_argument("--seed", type=int, default=140)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin nothing after this time")
    parser.add_argument("--folder", type=Path, default=Path("out") / "few_photos", help="captures")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    given = parser.parse_args()
    if given.what == "page":
        rows = [json.loads(line) for line in (given.store or STORED).read_text(encoding="utf-8").splitlines()]
        print(table(rows), published_table(rows), sep="\n\n")
        CHART.write_text(chart(rows), encoding="utf-8")
        return 0
    store, folder = Store("few_photos", given.store, given.any_commit), given.folder.resolve()
    kinds = [getattr(given, name).split(",") for name in ("objects", "materials", "engines", "tasks")]
    drawn = list(itertools.product(*kinds))
    order = np.random.default_rng(27).permutation(len(drawn))
    steps = list[Step]()
    for obj, material, engine, task in (drawn[k] for k in order):
        jobs = [Job(task, obj, material, engine, given.seed, photos) for photos in given.photos.split(",")]
        jobs = [job for job in jobs if store.known(job.key) is None]
        if jobs:
            capture = Step(make_whole, lambda job=jobs[0]: (job, folder), spoils=_said)
            steps.append(capture)
            scenes: dict[int, Step] = {}
            for job in jobs:
                every = lambda job=job: (job, folder, given.device)  # noqa: E731
                if PHOTOS[job.photos] not in scenes:
                    scenes[PHOTOS[job.photos]] = Step(make_scene, every, (capture,), spoils=_said)
                    steps.append(scenes[PHOTOS[job.photos]])
                done = lambda row, job=job: store.add(job.key, row)  # noqa: E731
                steps.append(Step(_timed, every, (scenes[PHOTOS[job.photos]],), done, spoils=_said))
    began = time.monotonic()
    with ProcessPoolExecutor(given.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        left = run_steps(pool, steps, given.workers, given.seconds - (time.monotonic() - began))
    print(f"{left} steps are left.", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
