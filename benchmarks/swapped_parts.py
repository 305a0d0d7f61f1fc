"""What of a fitted world costs its predictions: one part at a time is taken from the truth, after the fit.

    python benchmarks/swapped_parts.py run --seed 101 --tasks push --engines mujoco,rapier --objects box,l_block
    python benchmarks/swapped_parts.py run --seed 103 --tasks push --engines mujoco,rapier,dart --damping 0.25,0.4,0.6
    python benchmarks/swapped_parts.py table

Captures are those of `fall_push.py`; each is fitted once, and the ten test motions are predicted in the fitted world,
in the true one under our law of contact (the floor), and in mixtures of both: shape, mass (with its centre and
inertia), the two frictions, and the contact numbers (natural time and damping ratio) of the ground and of the
fingertip. With `--damping` the fingertip's damping ratio alone is also set to each of some values.
Beside these stands the fitted world with the numbers of contact as the fit to the tracks had them, before their
refinement with the images. `error_budget.py` gives the truth to the fit instead, which can then spend it on something
else.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.pipeline.demo.truth_tables import OBJECT
from cgwm.pipeline.physics.body import Body
from cgwm.pipeline.physics.contact_law import ContactLaw
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.world import World
from cgwm.schemas import CgwmError, NotConvergedError
from cgwm.schemas.materials import of_pair
from contenders.cgwm_default import Cgwm
from contenders.floor import Floor
from contenders.training import rolled_out
from fall_push import Work
from scoring import Judge, pose_errors
from store import Store
from tabletop import MATERIALS
from tabletop.jobs import CaptureJob

PARTS = ("shape", "mass", "friction", "fingertip's friction", "ground's numbers", "fingertip's numbers")


def measure(job: CaptureJob, work: Work, damping: Sequence[float] = ()) -> dict[str, Any]:
    """Fit a capture, and return the errors of its tests (mm, deg) in every mixture of the fitted and the true world.

    Args:
        job: The capture.
        work: Where things lie.
        damping: Damping ratios of the fingertip that are tried in the fitted world.
    """
    try:
        work.make_capture(job.task, job.object, job.material, job.engine)
        work.make_splats(job.task, job.object)
        cell = work.cell(job.task, job.object, job.material, job.engine)
        fitted, judge = Cgwm().fit(cell, None), Judge.of(cell, 0)
    except CgwmError as error:
        return vars(job) | {"failed": error.found}
    learned, true = world_of_model(fitted.model), Floor().fit(cell, None).world
    worlds = {"fitted": learned, **{part: mixed(learned, true, (part,)) for part in PARTS}, "floor": true}
    worlds["as the tracks have it"] = with_numbers(learned, true, fitted.record["parameters_from_tracks"])
    worlds |= {f"damping ratio {ratio:g}": damped(learned, true, ratio) for ratio in damping if true.pair_laws}
    errors = {name: _errors(world, judge) for name, world in worlds.items()}
    fit = {name: fitted.record[name] for name in ("parameters", "parameters_from_tracks", "intervals_95")}
    return vars(job) | {"fit": fit, "true_friction": judge.truth.contact.friction, "errors": errors}


def mixed(learned: World, true: World, parts: Sequence[str]) -> World:
    """Return the learned world with some of `PARTS` of the true one."""
    index = learned.body_names.index(OBJECT)
    bodies = [replace(body, material=body.name) for body in learned.bodies]
    bodies[index] = _body(bodies[index], true.bodies[index], parts)
    ground = _law(learned.contact, true.contact, "friction" in parts, "ground's numbers" in parts)
    pairs = {}
    for pair, law in true.pair_laws.items():
        mine = learned.pair_laws.get(pair, learned.contact)
        pairs[pair] = _law(mine, law, "fingertip's friction" in parts, "fingertip's numbers" in parts)
    return replace(learned, bodies=tuple(bodies), contact=ground, pair_laws=pairs, ground_material=true.ground_material)


def with_numbers(learned: World, true: World, numbers: Mapping[str, float]) -> World:
    """Return the learned world with other numbers of its contacts and height of its ground, by their names in a fit."""
    world = mixed(learned, true, ())
    height = numbers.get("ground_offset_m")
    if height is not None and world.ground_offset is not None:
        world = replace(world, ground_offset=torch.full_like(world.ground_offset, height))
    pairs = {pair: _numbered(law, pair, numbers) for pair, law in world.pair_laws.items()}
    return replace(world, contact=_numbered(world.contact, None, numbers), pair_laws=pairs)


def _numbered(law: Any, pair: tuple[str, str] | None, numbers: Mapping[str, float]) -> ContactLaw:
    given = {name: numbers.get(of_pair(name, pair)) for name in vars(law)}
    return replace(law, **{k: torch.full_like(getattr(law, k), v) for k, v in given.items() if v is not None})


def damped(learned: World, true: World, ratio: float) -> World:
    """Return the learned world with another damping ratio of what its pairs of materials, the fingertip's, touch."""
    world = mixed(learned, true, ())
    laws = {
        pair: replace(law, damping_ratio=torch.full_like(law.damping_ratio, ratio))
        for pair, law in world.pair_laws.items()
    }
    return replace(world, pair_laws=laws)


def _body(mine: Body, true: Body, parts: Sequence[str]) -> Body:
    names = ["centers", "radii", "on_plane", "hull", "patch"] if "shape" in parts else []
    names += ["mass", "inertia", "com"] if "mass" in parts else []
    return replace(mine, **{name: getattr(true, name) for name in names})


def _law(mine: Any, true: Any, friction: bool, numbers: bool) -> ContactLaw:
    other = true if numbers else mine
    return ContactLaw((true if friction else mine).friction, other.contact_time_s, other.damping_ratio)


def _errors(world: World, judge: Judge) -> list[tuple[float, float]]:
    rows = []
    for episode in judge.episodes:
        try:
            found = pose_errors(rolled_out(world, episode.start, episode.drives, episode.times_s), episode)
            rows.append((round(found["translation_mm"], 2), round(found["rotation_deg"], 2)))
        except NotConvergedError:
            rows.append((float("inf"), float("inf")))
    return rows


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the medians of every capture in Markdown, mm / deg, after the errors of friction."""
    names = ["fitted", *PARTS, "floor"]
    names += sorted({name for row in rows for name in row.get("errors", {})} - set(names))
    lines = ["| capture | friction %, before | " + " | ".join(names) + " |", "| --- " * (len(names) + 2) + "|"]
    for row in rows:
        words = f"{row['task']}, {row['object'].replace('_', '-')}, {row['material']}, {row['engine']}"
        if "failed" in row:
            lines.append(f"| {words} | – | failed: {row['failed']} |" + " |" * (len(names) - 1))
            continue
        middle = {name: np.median(np.array(values), axis=0) for name, values in row["errors"].items()}
        cells = [f"{middle[n][0]:.1f} / {middle[n][1]:.1f}" if n in middle else "–" for n in names]
        lines.append(f"| {words} | {_friction(row)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _friction(row: dict[str, Any]) -> str:
    """Return the errors of friction of a fit [%], as it is and before it was refined with images."""
    found = [row["fit"].get(name, {}).get("friction") for name in ("parameters", "parameters_from_tracks")]
    true = row.get("true_friction")
    return ", ".join(f"{100 * (value / true - 1):+.0f}" for value in found if value is not None) if true else "–"


def main() -> int:
    """Measure what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("--tasks", default="push")
    parser.add_argument("--objects", default="box,l_block")
    parser.add_argument("--materials", default=",".join(MATERIALS))
    parser.add_argument("--engines", default="mujoco,rapier")
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--damping", default="", help="damping ratios of the fingertip to try, separated by commas")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--folder", type=Path, default=Path("out") / "swapped_parts", help="captures and models")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    given = parser.parse_args()
    store = Store("swapped_parts", given.store, given.any_commit)
    if given.what == "run":
        work = Work(given.folder.resolve(), given.seed, given.device, psnr_every=10)
        damping = [float(one) for one in given.damping.split(",") if one]
        kinds = [getattr(given, name).split(",") for name in ("tasks", "objects", "materials", "engines")]
        for task, name, material, engine in itertools.product(*kinds):
            job = CaptureJob(task, name, material, engine, given.seed)
            store.result(job.key, lambda job=job: measure(job, work, damping))
    print(table(store.results()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
