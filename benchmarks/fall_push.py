"""The benchmark: Fall, Push and Tip. One motion of 15 frames to learn from, longer ones to predict open loop.

python benchmarks/fall_push.py --folder /tmp/tabletop --device cpu --workers 2 [--objects box --rows "cgwm; frozen"]
python benchmarks/fall_push.py --folder /tmp/tabletop --engines mujoco,drake,dart,rapier --rows "cgwm; frozen; floor"
python benchmarks/fall_push.py --table
python benchmarks/fall_push.py --table --by-engine

The truth is MuJoCo, or what --engines names (`tabletop/engines`); captures of another seed are other motions. The
engine `cgwm` is our own, against which the rows of cgwm and of the floor alone are measured, for an error budget.
Every (engine, task, object, material, row) is a stored result, taken up again, so that the table can be finished in
several runs, on several machines: join the stores' lines. What is there of captures, models and drafts (the motions
drawn so far of a capture whose search was cut off) is used. The photos of an object are the same whatever the ground,
the engine and the motions, so that its model is fitted once with a fingertip and once without.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from cgwm.pipeline.fit import fit
from cgwm.pipeline.rendering.contact_sheets import contact_sheet, small_png, tiles
from cgwm.schemas import CgwmError, NotConvergedError, SplatConfig
from contenders.base import Cell, Fitted
from contenders.cgwm_default import FittedCgwm
from contenders.rows import FLOOR, REFERENCE, ROWS
from fall_push_engines import engine_table
from fall_push_table import table
from scoring import Judge
from steps import Step, run_steps
from store import Store, timed
from tabletop.capture import TASKS, Task
from tabletop.draft import NO_DRAFT, Draft
from tabletop.engines import ENGINES, JUDGES, refusal
from tabletop.objects import load_item
from tabletop.plan import TEST_FRAMES

TESTS = 10
DEFAULT = [name for name, row in ROWS.items() if not row.fetched]
ENGINE = "mujoco"
"""The engine of the older results."""
UNABLE = {("tip", "mug")}
"""Task and object for which no motion serves: of 400 pushes none topples the mug, whatever the engine."""


@dataclass(frozen=True)
class Job:
    """One result to measure."""

    task: str
    object: str
    material: str
    row: str
    cell: Cell
    engine: str = ENGINE

    @property
    def key(self) -> str:
        """The result's key in the store."""
        names = (self.task, self.object, self.material, self.row, f"seed {self.cell.seed}", self.cell.device)
        return "/".join(names if self.engine == ENGINE else (*names, self.engine))


@dataclass(frozen=True)
class Work:
    """Where captures and models lie, and how they are made."""

    folder: Path
    seed: int
    device: str
    psnr_every: int = 1
    """Frames of test videos that are looked at: every so manyth; 0: none."""
    drafts: Path | None = None
    """Where the motions drawn so far of each capture are kept."""

    def capture(self, task: str, obj: str, material: str, engine: str = ENGINE) -> Path:
        """Return the directory of a capture, which has no other frames of test videos than are looked at."""
        name = f"{obj}_{material}_{task}" + ("" if self.psnr_every == 1 else f"_{self.psnr_every}")
        return self.folder / ("" if engine == ENGINE else engine) / name

    def draft(self, task: str, obj: str, material: str, engine: str) -> Draft:
        """Return what keeps the motions of a capture that are drawn so far."""
        name = f"{task}_{obj}_{material}_{engine}_{self.seed}.json"
        return NO_DRAFT if self.drafts is None else Draft(self.drafts / name)

    def splats(self, task: str, obj: str) -> Path:
        """Return the directory of a model without physics."""
        return self.folder / "models" / f"{obj}_{_photographed(task)}"

    def cell(self, task: str, obj: str, material: str, engine: str = ENGINE) -> Cell:
        """Return what contenders are given; photos, and so splats, are the same whatever the engine."""
        return Cell(self.capture(task, obj, material, engine), self.splats(task, obj), self.device, self.seed)

    def make_capture(self, task: str, obj: str, material: str, engine: str = ENGINE) -> None:
        """Make a capture where there is none; its cameras are the true ones."""
        path = self.capture(task, obj, material, engine)
        if not path.exists():
            from tabletop import make_capture

            path.parent.mkdir(parents=True, exist_ok=True)
            every, draft = self.psnr_every or TEST_FRAMES, self.draft(task, obj, material, engine)
            make_capture(
                path, obj, material, cast(Task, task), self.seed, TESTS, engine=engine, tests_every=every, draft=draft
            )

    def make_splats(self, task: str, obj: str) -> None:
        """Fit the spheres of an object to its photos, from a capture without tests."""
        out, kind = self.splats(task, obj), _photographed(task)
        if not out.exists():
            from tabletop import make_capture

            photos = self.folder / "photos" / f"{obj}_{kind}"
            if not photos.exists():
                photos.parent.mkdir(parents=True, exist_ok=True)
                make_capture(photos, obj, "wood", kind, self.seed, tests=0)
            config = SplatConfig(seed=self.seed, device=self.device)  # pyright: ignore[reportArgumentType]
            fit(photos, out, stage="sg-gs", splat_config=config)


def _photographed(task: str) -> Task:
    """Return a task with the same photos and bodies: only whether there is a fingertip matters."""
    return "fall" if task == "fall" else "push"


def measure(job: Job, budget_s: float | None, psnr_every: int, pictures: Path | None = None) -> dict[str, Any]:
    """Fit and judge one row in one cell. A fit that fails is a result, too: `failed` says why.

    Args:
        job: The row and the cell.
        budget_s: How long the fit may take, None for as long as it takes.
        psnr_every: See `Work`.
        pictures: Folder for the reference's worst prediction of each capture, None for no pictures.
    """
    figures = _of_job(job) | {"budget_s": budget_s, "psnr_every": psnr_every}
    return figures | timed(lambda: _measured(job, budget_s, psnr_every, pictures))


def _of_job(job: Job) -> dict[str, Any]:
    figures = {key: getattr(job, key) for key in ("task", "object", "material", "row", "engine")}
    return figures | {"seed": job.cell.seed, "device": job.cell.device}


def _measured(job: Job, budget_s: float | None, psnr_every: int, pictures: Path | None) -> dict[str, Any]:
    started = time.perf_counter()
    try:
        fitted = ROWS[job.row].make().fit(job.cell, budget_s)
    except Exception as error:  # whatever a contender dies of is its result
        reason = error.found if isinstance(error, CgwmError) else f"{type(error).__name__}: {error}"
        return {"failed": reason, "fit": {"seconds": round(time.perf_counter() - started, 2)}}
    judge, record = Judge.of(job.cell, psnr_every), fitted.record
    errors = judge.parameter_errors(record.get("parameters", {}))
    budget = {}
    if isinstance(fitted, FittedCgwm) and job.row == REFERENCE:
        truth = judge.truth.contact
        known = fitted.with_friction(truth.friction, truth.friction_fingertip)
        budget = {"true_friction": replace(judge, videos=None).episode_errors(known)}
    if job.engine != ENGINE:  # nobody else has the numbers of MuJoCo's contacts
        errors = {name: value for name, value in errors.items() if name == "friction"}
    episodes = judge.episode_errors(fitted)
    if pictures is not None and job.row == REFERENCE and judge.videos is not None:
        _picture(job, judge, fitted, episodes, pictures)
    return {"fit": record, "parameter_errors": errors, "episodes": episodes} | budget


def _picture(job: Job, judge: Judge, fitted: Fitted, episodes: Sequence[dict[str, Any]], folder: Path) -> None:
    """Write the frames of the episode with the largest error in place: above as filmed, below as predicted."""
    worst = max(episodes, key=lambda one: one.get("translation_mm", -1.0))
    strip = judge.strip(fitted, worst["episode"])
    folder.mkdir(parents=True, exist_ok=True)
    name = "_".join((job.task, job.object, job.material, job.engine, worst["episode"]))
    (folder / f"{name}.png").write_bytes(small_png(contact_sheet(tiles(strip, 160)), 80_000))


def run(
    work: Work,
    store: Store,
    names: dict[str, Sequence[str]],
    pool: Executor,
    captures: int | None = None,
    workers: int = 1,
    seconds: float = float("inf"),
    first: Sequence[str] = (),
    pictures: Path | None = None,
) -> int:
    """Make what is missing of captures, models and results, and return how many steps are left.

    Cell by cell; in each the reference first, since it sets the others' budgets.

    Args:
        work: Where things lie.
        store: Takes the results, as they come.
        names: Which tasks, objects, materials, engines and rows are wanted.
        pool: Who works.
        captures: So many captures of every engine and task, see `drawn`; None for all.
        workers: How many steps run at once.
        seconds: No step begins later.
        first: Objects whose captures come first, see `ordered`.
        pictures: See `measure`.
    """
    made: dict[tuple[str, ...], Step] = {}
    steps: list[Step] = []

    def once(key: tuple[str, ...], make: Callable[[], Step]) -> Step:
        if key not in made:
            made[key] = make()
            steps.append(made[key])
        return made[key]

    for cell in ordered(drawn(names, captures), first, store.results()):
        task, obj, material, engine = cell
        of_cell = work.cell(task, obj, material, engine)
        rows = [row for row in names["rows"] if engine in JUDGES or row in (REFERENCE, FLOOR)]
        jobs = [Job(task, obj, material, row, of_cell, engine) for row in rows]
        jobs = [job for job in jobs if store.known(job.key) is None]
        if not jobs:
            continue
        capture = once(cell, partial(_capture_step, work, store, jobs, cell))
        photos = (_photographed(task), obj)
        splats = once(photos, partial(Step, work.make_splats, lambda photos=photos: photos))
        step = partial(_measuring, store, psnr_every=work.psnr_every, pictures=pictures)
        reference = [step(job, (capture, splats)) for job in jobs if job.row == REFERENCE]
        steps += reference
        steps += [step(job, (capture, splats, *reference)) for job in jobs if job.row != REFERENCE]
    return run_steps(pool, steps, workers, seconds)


def drawn(names: dict[str, Sequence[str]], captures: int | None) -> list[tuple[str, str, str, str]]:
    """Return task, object, material and engine of every capture, without what the engine or the task cannot have.

    With a number of captures: of every engine and task so many, in an order of objects and materials that is drawn once
    and for all, first one of each task and engine, then another.
    """
    pairs = list(itertools.product(names["objects"], names["materials"]))
    if captures is not None:
        pairs = [pairs[k] for k in np.random.default_rng(0).permutation(len(pairs))]
    solids = {obj: load_item(obj).solid for obj in names["objects"]}  # once each: a scan takes seconds
    able = {engine: [pair for pair in pairs if refusal(engine, solids[pair[0]]) is None] for engine in names["engines"]}
    cells = [
        (index, (task, pair[0], pair[1], engine))
        for engine in names["engines"]
        for task in names["tasks"]
        for index, pair in enumerate([one for one in able[engine] if (task, one[0]) not in UNABLE][:captures])
    ]
    return [cell for _, cell in (sorted(cells, key=lambda one: one[0]) if captures is not None else cells)]


def ordered(
    cells: Sequence[tuple[str, str, str, str]], first: Sequence[str], results: Sequence[dict[str, Any]]
) -> list[tuple[str, str, str, str]]:
    """Return cells with those of the objects `first` first, in that order; without such objects as they are.

    Cells that have a result already come last, since a table that was cut off lacks whole objects rather than rows.
    """
    if not first:
        return list(cells)
    begun = {(row["task"], row["object"], row["material"], row.get("engine", ENGINE)) for row in results}
    rank = {obj: place for place, obj in enumerate(first)}
    return sorted(cells, key=lambda cell: (cell in begun, rank.get(cell[1], len(rank))))


def _capture_step(work: Work, store: Store, jobs: Sequence[Job], cell: tuple[str, str, str, str]) -> Step:
    """Return the step that makes a capture; where no motion serves, its results say so."""

    def spoils(error: BaseException) -> None:
        if not isinstance(error, NotConvergedError):
            raise error
        for job in jobs:
            store.add(job.key, {**_of_job(job), "not_run": error.found})

    return Step(work.make_capture, lambda: cell, spoils=spoils)


def _measuring(store: Store, job: Job, needs: Sequence[Step], psnr_every: int, pictures: Path | None) -> Step:
    return Step(measure, lambda: (job, _budget(store, job), psnr_every, pictures), needs, partial(store.add, job.key))


def _budget(store: Store, job: Job) -> float | None:
    """Return the seconds that a job may take: so many times what the reference took in the same cell."""
    factor = ROWS[job.row].budget
    if factor is None:
        return None
    reference = store.known(replace(job, row=REFERENCE).key)
    if reference is None:
        raise SystemExit(f"{job.key}: its budget is the time of the row '{REFERENCE}', which is to be in --rows first.")
    return factor * reference["fit"]["seconds"]


def main() -> int:
    """Measure what is missing, or print the table of what is stored."""
    from tabletop import MATERIALS, OBJECTS

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", default="fall,push")
    parser.add_argument("--engines", default=ENGINE, help="whose motions are the truth: " + ", ".join(ENGINES))
    parser.add_argument("--objects", default=",".join(OBJECTS))
    parser.add_argument("--materials", default=",".join(MATERIALS))
    parser.add_argument("--rows", default="; ".join(DEFAULT), help="names of rows, separated by semicolons")
    parser.add_argument("--captures", type=int, help="of every engine and task, drawn; left out, all")
    parser.add_argument("--first", default="", help="objects whose captures come first; those with results come last")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no step after this time")
    parser.add_argument("--folder", type=Path, default=Path("out") / "fall_push", help="captures and models")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    parser.add_argument("--psnr-every", type=int, default=1, help="compare every so manyth frame; 0: none")
    parser.add_argument("--drafts", type=Path, default=None, help="keeps drawn motions, for a search that is cut off")
    parser.add_argument("--pictures", type=Path, default=None, help="takes pictures of cgwm's worst predictions")
    parser.add_argument("--by-engine", action="store_true", help="with --table: rows against each engine")
    parser.add_argument("--table", action="store_true", help="print the table of what is stored, and measure nothing")
    given = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"  # the workers start with it
    store = Store("fall_push", given.store, given.any_commit)
    kinds = ("tasks", "objects", "materials", "engines")
    names: dict[str, Sequence[str]] = {key: [one.strip() for one in getattr(given, key).split(",")] for key in kinds}
    names["rows"] = [one.strip() for one in given.rows.split(";")]
    for key, legal in (
        ("tasks", TASKS),
        ("objects", OBJECTS),
        ("materials", MATERIALS),
        ("engines", ENGINES),
        ("rows", ROWS),
    ):
        unknown = [one for one in names[key] if one not in legal]
        if unknown:
            parser.error(f"--{key}: {unknown[0]!r} is none of {', '.join(legal)}")
    if not given.table:
        work = Work(given.folder.resolve(), given.seed, given.device, given.psnr_every, given.drafts)
        with ProcessPoolExecutor(given.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
            first = [one.strip() for one in given.first.split(",") if one.strip()]
            left = run(work, store, names, pool, given.captures, given.workers, given.seconds, first, given.pictures)
        print(f"{left} steps are left.", file=sys.stderr)
    print(engine_table(store.results(), names) if given.by_engine else table(store.results(), names, given.seed))
    return 0


if __name__ == "__main__":
    sys.exit(main())
