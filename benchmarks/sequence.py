"""Experiments in sequence: does `cgwm diagnose` name an effect of contact once it got the motions that it asked for?

    python benchmarks/sequence.py run --stage development --each 1 --nulls 1 --groups mujoco --workers 2
    python benchmarks/sequence.py run --stage report1 --groups mujoco --workers 16 --seconds 500   # again, until 0 left
    python benchmarks/sequence.py make --stage report1 --groups drake,dart,rapier      # on a machine with these engines
    python benchmarks/sequence.py table --stage report1 --groups mujoco [--record]

Each case begins as six mixed tosses of a cube or a ball with one large effect of contact, or none, made by an engine
that is not cgwm's. It is fitted and diagnosed as a user would do it. Where the diagnosis asks for motions (at most
three a round), these are made in the same engine with the same hidden effect, with the scatter of a hand (10 % of each
speed and height, 10 degrees of direction, 2 degrees where a drop flat on a face is asked for, 2 cm of place), measured
with the same noise and added to the training split; at most twice. Captures and diagnoses are kept round by round under
out/sequence/, so that one machine can make what another one asked for: `run` does what it can, and leaves a case alone
whose engine is not installed. Thresholds may be chosen on the stage development alone, whose seeds are even.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import shutil
import sys
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args
from zlib import crc32

import numpy as np
from cgwm.datasets.capture.manifest import write_manifest
from cgwm.datasets.capture.tracks import tracks_csv
from cgwm.datasets.synthetic.hidden_effects.mechanics import Mechanics, Start, build
from cgwm.datasets.synthetic.hidden_effects.plan import planned_case
from cgwm.datasets.synthetic.hidden_effects.record import measured
from cgwm.datasets.synthetic.hidden_effects.rotation import rotation_of, turn
from cgwm.datasets.synthetic.hidden_effects.things import Kind
from cgwm.pipeline.diagnose import diagnose
from cgwm.pipeline.fit import fit
from cgwm.schemas import CaptureManifest, CgwmError, PhysConfig, read_toml
from contenders.effects_cgwm import taken
from diagnose import SILENT, brief, judged
from hidden_effects import EFFECTS, Case, make_capture
from hidden_effects import ENGINES as KNOWN_ENGINES
from real_like.engines import ENGINE_OF, GROUPS, can_hide, missing
from real_like.score import rate, wilson
from render_results import record
from store import ROOT, Store, commit_of_tree, timed

Stage = Literal[
    "development",
    "report1",
    "report2",
    "report3",
    "report4",
    "report5",
    "report6",
    "report7",
    "report8",
    "report9",
    "report10",
    "report11",
    "report12",
]
STAGES: tuple[Stage, ...] = get_args(Stage)
"""Each report stage is read once, after everything is fixed; the next run takes the next one."""
ROUNDS = 2
"""How often a diagnosis may ask for motions."""
MOST_MOTIONS = 3
SPEED_SCATTER, TURN_SCATTER_RAD, PLACE_SCATTER_M = 0.1, math.radians(10.0), 0.02
"""Standard deviations of what a hand does: of each speed and height as a share, of the direction, and of the place."""
FLAT_SCATTER_RAD = math.radians(2.0)
"""The same of how flat a drop is that was asked for as flat, about each level axis: half of the drops are off by less
than 2.4 deg, one in nine by more than 4.2."""
LEAST_HEIGHT_M = 2e-4
"""Height of the lowest point over the ground in motions that begin there."""
EACH, NULLS = 4, 12
"""Captures of each effect, body and group, and nulls of each group, of a report."""
NAMED = ("exact", "exact, and more")
COLUMNS = ("exact", "exact, and more", "among", "silent", "family", "wrong", "unexplained", "refused")
LEAST_NAMED, MOST_WRONG = 0.8, 0.05
WRONG = ("exact, and more", "family", "wrong", "false alarm")
KNOWN_ENGINES.update({group: module for group, (module, _) in GROUPS.items()})


@dataclass(frozen=True)
class SequenceCase:
    """A case and the group of its engine."""

    case: Case
    group: str

    @property
    def name(self) -> str:
        """Stable name."""
        return self.case.name


def sequence_cases(stage: Stage, each: int = EACH, nulls: int = NULLS) -> list[SequenceCase]:
    """Return the cases of a stage: each large effect of contact on each body in each group that can hide it, and nulls.

    A case's name, and with it all that is drawn, does not depend on how many there are.

    Raises:
        ValueError: If there is no such stage.
    """
    if stage not in STAGES:
        raise ValueError(f"stage '{stage}'; there are {', '.join(STAGES)}")
    things: tuple[Kind, Kind] = ("cube", "ball")
    found = [
        _case(stage, group, thing, (name,), k)
        for group in GROUPS
        for name, entry in EFFECTS.items()
        if entry.acts == "contact" and can_hide(group, name)
        for thing in entry.things
        for k in range(each)
    ]
    return found + [_case(stage, group, things[k % 2], (), k) for group in GROUPS for k in range(nulls)]


def _case(stage: Stage, group: str, thing: Kind, effects: tuple[str, ...], k: int) -> SequenceCase:
    name = "/".join(("sequence", stage, group, thing, *(effects or ("null",)), str(k)))
    seed = 2 * (crc32(name.encode()) // 2) + (stage != "development")
    # the measurement is that of the other cases: 60 to 148 Hz, 0.2 to 2 mm
    like = replace(planned_case("development", "study", thing, effects, "large", k), name=name, seed=seed)
    rng = like.rng("measurement")
    share = rng.uniform()
    case = replace(
        like,
        law=GROUPS[group][1],
        engine=group,
        rate_hz=float(rng.choice((60.0, 100.0, 148.0))),
        position_std_m=round(0.0002 * 10.0**share, 6),
        rotation_std_rad=round(math.radians(0.1 * 6.0**share), 6),
    )
    return SequenceCase(case, group)


@dataclass(frozen=True)
class Desk:
    """The folder of a case: captures by round, the truth, and what each diagnosis said."""

    folder: Path
    of: SequenceCase

    def capture(self, number: int) -> Path:
        """Return the capture that the diagnosis of a round sees."""
        return self.folder / f"capture{number}"

    def said(self, number: int) -> dict[str, Any] | None:
        """Return what the diagnosis of a round said at this commit; None if it was not asked."""
        path = self.folder / f"diagnosis{number}.json"
        row = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
        return row if row is not None and row["commit"] == commit_of_tree() else None

    def truth(self) -> dict[str, Any]:
        """Return the truth, with what the engine's law of contact has by itself."""
        return json.loads((self.folder / "truth.json").read_text(encoding="utf-8"))

    def make(self, number: int) -> bool:
        """Make the capture of a round unless it is there; return whether it is now."""
        wanted = self.capture(number)
        asked = [] if number == 0 else self._asked(number - 1)
        if wanted.is_dir() and (number == 0 or self._made_for(number) == asked):
            return True
        if missing(self.of.group):
            return False
        if number == 0:
            self.folder.mkdir(parents=True, exist_ok=True)
            make_capture(wanted, self.of.case, self.folder / "truth.json", overwrite=True)
            return True
        shutil.rmtree(wanted, ignore_errors=True)
        shutil.copytree(self.capture(number - 1), wanted)
        add_motions(wanted, self.of.case, asked, number)
        (self.folder / f"made{number}.json").write_text(json.dumps(asked), encoding="utf-8")
        return True

    def diagnose(self, number: int) -> dict[str, Any]:
        """Fit and diagnose the capture of a round, and keep what was said."""
        model = self.folder / f"m{number}"
        began = time.process_time()
        shutil.rmtree(model, ignore_errors=True)
        try:
            took = taken(fit(self.capture(number), model, phys_config=PhysConfig()))
            found: dict[str, Any] = diagnose(model, self.capture(number)).model_dump(mode="json")
            if took:  # a user reads what the default fit takes into the model by itself before any diagnosis
                found["selected"] = [*found["selected"], *took]
                found["verdict"] = "missing_effect" if found["verdict"] in SILENT else found["verdict"]
        except CgwmError as error:
            found = {"refused": error.found}
        asked = (found.get("next_motions") or {}).get("motions", [])[:MOST_MOTIONS]
        row = {"commit": commit_of_tree(), "asked": asked, "judged": judged(self.of.case, self.truth(), found)}
        row |= {"found": brief(found), "cpu_s": round(time.process_time() - began, 1)}
        shutil.rmtree(model, ignore_errors=True)
        (self.folder / f"diagnosis{number}.json").write_text(json.dumps(row), encoding="utf-8")
        return row

    def _asked(self, number: int) -> list[dict[str, Any]]:
        path = self.folder / f"diagnosis{number}.json"
        return json.loads(path.read_text(encoding="utf-8"))["asked"] if path.is_file() else []

    def _made_for(self, number: int) -> list[dict[str, Any]] | None:
        path = self.folder / f"made{number}.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None

    def make_asked(self) -> int:
        """Make all captures that are asked for and can be made; return how many rounds are there now."""
        made = 0
        while made <= ROUNDS and (made == 0 or self._asked(made - 1)) and self.make(made):
            made += 1
        return made


def add_motions(capture: Path, case: Case, motions: Sequence[dict[str, Any]], number: int) -> None:
    """Make motions in the case's engine, with the scatter of a hand, and add them to the training split."""
    hidden = case.drawn_effects()
    world = build(Mechanics.of(case.drawn_thing(), case.law), hidden)
    manifest = read_toml(capture / "capture.toml", CaptureManifest)
    splits = dict(manifest.splits)
    for k, motion in enumerate(motions):
        name = f"r{number}_{k}"
        rng = case.rng(f"hand {name}")
        start = by_hand(case, motion["initial_state"], rng, flat=" flat " in motion["what"])
        length_s = float(motion["duration_s"])
        true = KNOWN_ENGINES[case.engine].simulate(world, hidden, start, length_s)
        track, _ = measured(replace(case, length_s=length_s), hidden, true, case.rng(f"noise {name}"))
        (capture / "tracks" / f"{name}.csv").write_text(tracks_csv({case.thing: track}), encoding="utf-8")
        splits["train"] = (*splits["train"], name)
    write_manifest(capture / "capture.toml", manifest.model_copy(update={"splits": splits}), overwrite=True)


def by_hand(case: Case, state: dict[str, list[float]], rng: np.random.Generator, flat: bool = False) -> Start:
    """Return a start as a hand makes it, scattered; what begins on the ground begins there.

    Args:
        case: The case.
        state: The first state that was asked for.
        rng: Of the scatter.
        flat: Whether a drop was asked for that is flat on a face, so that the hand has a guide.
    """
    position, velocity = np.array(state["position_m"]), np.array(state["velocity_m_s"])
    rotation = rotation_of(np.array(state["quat_wxyz"]))
    spin = rotation @ np.array(state["omega_body_rad_s"])
    about = turn(TURN_SCATTER_RAD * np.array([0.0, 0.0, rng.standard_normal()]))
    tipped = turn((FLAT_SCATTER_RAD if flat else TURN_SCATTER_RAD) * np.array([*rng.standard_normal(2), 0.0]))
    middles, radius = case.drawn_thing().spheres
    height = float(position[2] - radius + (middles @ rotation.T)[:, 2].min())
    on_ground = height < 5e-3
    # a body is laid flat on the ground, and let go a little askew
    turned = about @ rotation if on_ground else about @ tipped @ rotation
    velocity = about @ velocity * (1 + SPEED_SCATTER * rng.standard_normal())
    spin = about @ spin * (1 + SPEED_SCATTER * rng.standard_normal())
    position[:2] += PLACE_SCATTER_M * rng.standard_normal(2)
    height = LEAST_HEIGHT_M if on_ground else height * (1 + SPEED_SCATTER * rng.standard_normal())
    position[2] = radius - float((middles @ turned.T)[:, 2].min()) + max(height, LEAST_HEIGHT_M)
    from scipy.spatial.transform import Rotation

    quat = Rotation.from_matrix(turned).as_quat(scalar_first=True)
    return Start(position, quat, velocity, turned.T @ spin)


def measure(of: SequenceCase, root: Path) -> dict[str, Any] | None:
    """Return what was said round by round; None where a capture has to be made on another machine."""
    desk = Desk(root / of.name.replace("/", "__"), of)
    rounds: list[dict[str, Any]] = []
    for number in range(ROUNDS + 1):
        if not desk.make(number):
            return None
        said = desk.said(number) or desk.diagnose(number)
        rounds.append(said)
        if not said["asked"]:
            break
    truth = desk.truth()
    marks = [one["judged"] for one in rounds]
    return {
        "case": of.name,
        "group": of.group,
        "thing": of.case.thing,
        "effect": of.case.effects[0] if of.case.effects else None,
        "truth": [{key: effect[key] for key in ("name", "values")} for effect in truth["effects"]],
        "rate_hz": of.case.rate_hz,
        "position_std_m": of.case.position_std_m,
        # who asks for nothing stays with what was said
        "judged": marks + marks[-1:] * (ROUNDS + 1 - len(marks)),
        "rounds": [
            {
                "verdict": one["found"].get("verdict", "refused"),
                "selected": one["found"].get("selected", []),
                "aliases": one["found"].get("aliases", []),
                "asked": [motion["what"] for motion in one["asked"]],
                "contact": one["found"].get("contact", {}),
                "cpu_s": one["cpu_s"],
            }
            for one in rounds
        ],
    }


def _timed(of: SequenceCase, root: Path) -> dict[str, Any] | None:
    row = timed(lambda: measure(of, root) or {})
    return row if "case" in row else None


def _made(of: SequenceCase, root: Path) -> int:
    return Desk(root / of.name.replace("/", "__"), of).make_asked()


def run(todo: Sequence[SequenceCase], store: Store, root: Path, workers: int, deadline: float) -> tuple[int, int, int]:
    """Measure what is missing; return how many were measured, wait for another machine, and remain."""
    queue = [one for one in todo if store.known(one.name) is None]
    waiting: dict[Future[dict[str, Any] | None], SequenceCase] = {}
    done = elsewhere = 0
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        while queue or waiting:
            while queue and len(waiting) < workers and time.monotonic() < deadline:
                one = queue.pop(0)
                waiting[pool.submit(_timed, one, root)] = one
            if not waiting:
                break
            finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in finished:
                one = waiting.pop(future)
                error = future.exception()
                row = None if error else future.result()
                if error is not None:
                    store.add(one.name, {"case": one.name, "failed": f"{type(error).__name__}: {error}"})
                elif row is None:
                    elsewhere += 1
                else:
                    store.add(one.name, row)
                    done += 1
    return done, elsewhere, len(queue)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table: how cases are named before, after one round and after two, with Wilson intervals."""
    good = [row for row in rows if "judged" in row]
    hidden = [row for row in good if row["effect"]]
    words = ["before", *(f"after round {k}" for k in range(1, ROUNDS + 1))]
    head = ["captures", "when", "n", *COLUMNS, "named", "a wrong name"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    parts = {"all": hidden}
    parts |= {name: [r for r in hidden if f"{r['effect']}, {r['thing']}" == name] for name in _names(hidden)}
    parts |= {group: [r for r in hidden if r["group"] == group] for group in dict.fromkeys(r["group"] for r in hidden)}
    for name, some in parts.items():
        for number, when in enumerate(words):
            counts = Counter(row["judged"][number] for row in some)
            named = rate([row["judged"][number] in NAMED for row in some])
            wrong = rate([row["judged"][number] in WRONG for row in some])
            cells = [name, when, str(len(some)), *(str(counts[one]) for one in COLUMNS), named, wrong]
            lines.append("| " + " | ".join(cells) + " |")
    nulls = [row for row in good if not row["effect"]]
    lines += ["", "| nothing hidden | n | a wrong name |", "|---|---|---|"]
    for number, when in enumerate(words):
        lines.append(f"| {when} | {len(nulls)} | {rate([row['judged'][number] in WRONG for row in nulls])} |")
    lines += ["", "Not named after the last round:"]
    for row in good:
        if row["judged"][-1] not in (*NAMED, "right"):
            last = row["rounds"][-1]
            lines.append(f"- {row['case']}: {row['judged'][-1]} ({last['verdict']} {', '.join(last['selected'])})")
    lines += [f"- {row['case']}: failed ({row['failed'][:120]})" for row in rows if "failed" in row]
    asked = [len(one["asked"]) for row in good for one in row["rounds"][:ROUNDS]]
    if asked:
        lines.append(f"\nMotions asked for in a round: {np.mean(asked):.1f} on average, at most {max(asked)}.")
    seconds = [one["cpu_s"] for row in good for one in row["rounds"]]
    if seconds:
        lines.append(f"CPU seconds of a fit and its diagnosis: median {np.median(seconds):.1f}.")
    return "\n".join(lines)


def record_figures(rows: Sequence[dict[str, Any]], command: str, planned: int) -> None:
    """Record the figures of a report in benchmarks/results/diagnose.jsonl; planned: captures of the report."""
    hidden = [row for row in rows if row.get("effect")]
    nulls = [row for row in rows if "judged" in row and not row["effect"]]
    head, engines = "experiments in sequence", ", ".join(sorted({ENGINE_OF[row["group"]] for row in hidden}))
    if len(rows) < planned:
        engines += f"; the first {len(rows)} of {planned} captures in random order"
    what = "large effects of contact, named"
    for figure, marks, least, most in (
        (f"{head}: {what} after two rounds", [row["judged"][-1] in NAMED for row in hidden], LEAST_NAMED, None),
        (f"{head}: {what} before", [row["judged"][0] in NAMED for row in hidden], None, None),
        (f"{head}: a wrong name after two rounds", [row["judged"][-1] in WRONG for row in hidden], None, MOST_WRONG),
        (f"{head}: nothing hidden, a wrong name", [row["judged"][-1] in WRONG for row in nulls], None, MOST_WRONG),
    ):
        low, high = wilson(sum(marks), len(marks))
        share = sum(marks) / max(len(marks), 1)
        met = share >= least if least is not None else share <= most if most is not None else None
        target = f"{100 * least:g} %" if least is not None else f"at most {100 * most:g} %" if most is not None else ""
        record(
            "real_like",
            figure=figure,
            value=f"{sum(marks)} of {len(marks)} ({100 * share:.0f} %)",
            target=target,
            met=met,
            note=f"95 % interval {100 * low:.1f} to {100 * high:.1f} %; engines: {engines}",
            command=command,
        )


def _names(rows: Sequence[dict[str, Any]]) -> list[str]:
    return sorted({f"{row['effect']}, {row['thing']}" for row in rows})


def _in_groups(chosen: Sequence[SequenceCase], words: str) -> list[SequenceCase]:
    """Return the cases whose group or engine is named; all for no words."""
    wanted = [word for word in words.split(",") if word]
    unknown = [word for word in wanted if word not in {*GROUPS, *ENGINE_OF.values()}]
    if unknown:
        raise SystemExit(f"no group '{unknown[0]}'; there are {', '.join(GROUPS)}, and engines: mujoco for its three")
    return [one for one in chosen if not wanted or one.group in wanted or ENGINE_OF[one.group] in wanted]


def main(words: Sequence[str] | None = None) -> int:
    """Run, make captures or print the table; `words` are those of the command line unless given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "make", "table"))
    parser.add_argument("--stage", choices=STAGES, default="development")
    parser.add_argument("--each", type=int, default=EACH, help="captures of each effect, body and group")
    parser.add_argument("--nulls", type=int, default=NULLS, help="captures with nothing hidden, of each group")
    parser.add_argument("--groups", default="", help="groups or engines, separated by commas; default all")
    parser.add_argument("--only", default="", help="part of the name")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no case after this time")
    parser.add_argument("--captures", type=Path, default=None, help="where captures are kept; default out/sequence")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    parser.add_argument("--record", action="store_true", help="of table: write a report's figures to results/")
    given = parser.parse_args(words)
    if given.record and (given.only or not given.stage.startswith("report")):
        parser.error("--record wants a report: --stage report..., without --only.")
    os.environ["OMP_NUM_THREADS"] = "1"  # the workers start with it
    chosen = [one for one in sequence_cases(given.stage, given.each, given.nulls) if given.only in one.name]
    chosen = _in_groups(chosen, given.groups)
    root = given.captures or ROOT / "out" / "sequence" / given.stage
    if given.what == "make":
        able = [one for one in chosen if missing(one.group) is None]
        with ProcessPoolExecutor(given.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
            made = list(pool.map(_made, able, [root] * len(able)))
        print(
            f"{sum(made)} captures of {len(able)} cases are there; {len(chosen) - len(able)} cases lack their engine."
        )
        return 0
    store = Store("sequence", given.store, given.any_commit)
    left = 0
    if given.what == "run":
        # every kind of case early, so that a run that is cut off tells of all
        order = np.random.default_rng(0).permutation(len(chosen))
        deadline = time.monotonic() + given.seconds
        done, elsewhere, left = run([chosen[k] for k in order], store, root, given.workers, deadline)
        print(f"{done} measured, {elsewhere} wait for captures of another machine, {left} left.", file=sys.stderr)
    names = {one.name for one in chosen}
    rows = [row for row in store.results() if row["key"] in names]
    print(table(rows))
    if given.record:
        command = f"python benchmarks/sequence.py run --stage {given.stage} --each {given.each} --nulls {given.nulls}"
        record_figures(rows, command, len(names))
    return 3 if left else 0


if __name__ == "__main__":
    sys.exit(main())
