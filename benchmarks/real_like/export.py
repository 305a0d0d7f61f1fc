"""Write the benchmark so that another tool can run it: captures, the truth apart from them, the score and a README."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.hidden_effects import EFFECTS, KNOWN

from . import score
from .engines import missing
from .plan import RealCase
from .record import make_real_capture

README = """# What is missing? {count} motions of a body over level ground, measured as real ones are

1. `captures/<id>/capture.toml`: gravity, the body's shape [m] and mass, `group` (session) of each episode, the splits.
2. `captures/<id>/tracks/<episode>.csv`: `time_s`, `body`, `px_m`, `py_m`, `pz_m` of its centre in the world (z up) and,
   where measured, `qw`, `qx`, `qy`, `qz` (unit quaternion, body to world). Errors are slow, in bursts, or smoothed.
3. From the split `train` find what acts beside gravity, inertia and Coulomb contact: nothing, one or two of
   `effects.csv`, or something that it does not list. Write `answers.json`, by id:
   `{{"c0000": {{"named": ["wind"], "aliases": [["wind", "linear_drag"]], "unexplained": false}}}}`
   (`aliases`: groups that you cannot tell apart; `wind@episode`, `wind@group`: a value for each episode or session).
4. `python score.py truth/truth.json answers.json` prints the table; its docstring has the rules. It needs numpy.
5. Open `truth/` last. Whoever changes a tool after that reports on an export of another `--stage`, with other seeds.
"""


def export(out: Path, chosen: Sequence[RealCase], captures: Path, workers: int) -> int:
    """Write OUT with captures, truth, names of the effects, score and README; what is there already is kept.

    Args:
        out: The folder. It must be empty, or one that was begun with the same cases.
        chosen: The cases.
        captures: Where captures of `run` are kept, unused ones are made there.
        workers: Processes.

    Returns:
        0, or 1 if captures were left out since an engine is not installed.
    """
    able = [case for case in chosen if missing(case.group) is None]
    for case in chosen:
        if case not in able:
            print(f"{case.name}: not exported, {missing(case.group)} is not installed", file=sys.stderr)
    # an id tells neither the engine nor the kind
    order = np.random.default_rng(len(able)).permutation(len(able))
    names = {able[place].name: f"c{k:04d}" for k, place in enumerate(order)}
    plan, planned = out / "truth" / "plan.json", json.dumps(names, indent=1, sort_keys=True)
    if out.is_dir() and any(out.iterdir()) and (not plan.is_file() or plan.read_text(encoding="utf-8") != planned):
        print(f"{out} holds something else. Name an empty directory.", file=sys.stderr)
        return 2
    (out / "captures").mkdir(parents=True, exist_ok=True)
    (out / "truth").mkdir(exist_ok=True)
    plan.write_text(planned, encoding="utf-8")
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        jobs = [pool.submit(_one, case, out / "captures" / names[case.name], captures) for case in able]
        truths = {names[case.name]: job.result() for case, job in zip(able, jobs, strict=True)}
    ordered = dict(sorted(truths.items()))
    (out / "truth" / "truth.json").write_text(json.dumps(ordered, indent=1) + "\n", encoding="utf-8")
    shutil.copyfile(score.__file__, out / "score.py")
    (out / "effects.csv").write_text(_names(), encoding="utf-8")
    (out / "README.md").write_text(README.format(count=len(able)), encoding="utf-8")
    print(f"{len(able)} captures in {out}; {out / 'README.md'} says how to run a tool on them.")
    return 1 if len(able) < len(chosen) else 0


def _one(case: RealCase, folder: Path, captures: Path) -> dict[str, Any]:
    """Write one capture under its id, and return its truth."""
    made = captures / case.name.replace("/", "__")
    truth = captures.with_name(f"{captures.name}.truth") / f"{made.name}.json"
    if not (made.is_dir() and truth.is_file()):
        truth.parent.mkdir(parents=True, exist_ok=True)
        make_real_capture(made, case, truth, overwrite=True)
    if not folder.is_dir():
        unfinished = folder.with_name(f".{folder.name}.part")
        shutil.rmtree(unfinished, ignore_errors=True)
        shutil.copytree(made, unfinished)
        unfinished.rename(folder)
    return json.loads(truth.read_text(encoding="utf-8"))


def _names() -> str:
    """Return the effects that may be named, with where each acts, as CSV."""
    rows = [f"{name},{EFFECTS[name].acts},{_law(name)}" for name in KNOWN]
    return "\n".join(("name,acts in,law", *rows)) + "\n"


def _law(name: str) -> str:
    text = " ".join((EFFECTS[name].draw.__doc__ or "").split()).replace('"', "'")
    return f'"{text}"'
