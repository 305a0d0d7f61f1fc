"""The scenes with fixed surfaces (`cgwm demo --scene bin`, `--scene ramp`): from tracks to checked rollouts."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import rmtree
from typing import Any, Literal

import numpy as np

from ...datasets.capture.capture import Capture
from ...datasets.io.atomic import new_directory
from ...datasets.models.model import read_model, write_model
from ...datasets.rollouts.loader import RolloutReader
from ...datasets.synthetic.worlds import TRUTH_FILE, WorldPlan, make_world, plan_world
from ...schemas import (
    ComparedParameter,
    FittedParameter,
    ModelFile,
    PhysConfig,
    RolloutCheck,
    SamplingPlan,
    Solver,
    SynthesizeConfig,
    WorldDemoResult,
)
from ...schemas.materials import of_pair
from ..evaluate.stage import evaluate_model
from ..fit import fit
from ..phys_geo.material_pairs import start_laws
from ..phys_geo.stage import CROWDED_SWEEPS
from ..runtime.device import resolve_device
from ..runtime.timing import StagedRun
from ..synthesize.stage import synthesize
from ..validate.stage import validate
from .world_page import PICTURE, REPORT_HTML, REPORT_JSON, world_html, world_picture

Scene = Literal["bin", "ramp"]

SPLIT = "test"
AT_REST_M_S = 0.005
"""Speed below which a body counts as at rest."""
PHYSICS = PhysConfig(population=12, generations=2, iterations=4)
"""Settings of the fit: a shorter search than the default, since five bodies that hit each other are slow to predict."""
PLANS: dict[str, SamplingPlan] = {
    "bin": SamplingPlan.model_validate(
        {
            "start": "throw",
            "height_m": [0.0, 0.2],
            "offset_m": 0.03,
            "horizontal_speed_m_s": [0.0, 0.1],
            "vertical_speed_m_s": 0.0,
            "spin_rad_s": [0.0, 2.0],
        }
    ),
    "ramp": SamplingPlan.model_validate(
        {
            "start": "throw",
            "orientation": "photo",
            "height_m": [0.0, 0.01],
            "offset_m": 0.04,
            "heading_deg": 0.0,
            "horizontal_speed_m_s": [0.0, 0.3],
            "vertical_speed_m_s": 0.0,
            "spin_rad_s": 0.0,
        }
    ),
}
"""Starts of the rollouts: in the bin dropped in any orientation, on the ramp let go just above it."""
STATED_STEP_S = 0.0005
"""Step of a model whose contacts are as short as those of the bin [s]."""
_UNITS = {"friction": "1", "contact_time_s": "s", "damping_ratio": "1"}
SIZES = {"bin": (64, 2.0), "ramp": (16, 1.5)}
"""Number of rollouts and their length [s]."""


@dataclass(frozen=True)
class _World(StagedRun):
    """A run of such a scene."""

    scene: Scene
    """Name of the scene."""
    seed: int
    """Seed of the scene and of every stage."""
    device: str
    """auto, cpu or cuda."""
    rollouts: int
    """Number of rollouts."""


def run_world(
    out: Path,
    scene: Scene,
    seed: int = 0,
    device: str = "auto",
    overwrite: bool = False,
    rollouts: int | None = None,
    physics: PhysConfig | None = None,
) -> WorldDemoResult:
    """Make a world with fixed surfaces, fit it to tracks, predict test episodes, and make rollouts and check them.

    Args:
        out: The directory to write; it appears once it is complete.
        scene: bin or ramp.
        seed: Seed of the scene and of every stage.
        device: auto, cpu or cuda.
        overwrite: Replace what is at `out`.
        rollouts: Number of rollouts; default 64 in the bin, 16 on the ramp.
        physics: Settings of the fit; seed and device are filled in.

    Returns:
        The content of `report.json`.

    Raises:
        UsageError: If `out` exists, or a name or the seed is not allowed.
        NotConvergedError: If a stage fails; its message names the stage, and nothing is written.
    """
    resolve_device(device)  # refuse a wrong device now, not after minutes
    plan_world(scene, seed)
    config = (physics or PHYSICS).model_copy(update={"seed": seed, "device": device})
    with new_directory(Path(out), "demo", overwrite) as folder:
        run = _World(folder, Path(out), scene, seed, device, rollouts or SIZES[scene][0])
        return _run(run, config)


def _run(run: _World, physics: PhysConfig) -> WorldDemoResult:
    folder = run.folder
    with run.stage("make the scene"):
        plan = make_world(run.scene, folder / "capture", run.seed)
    with run.stage("fit"):
        file = (
            _stated(run, plan)
            if plan.contact.stated
            else fit(folder / "capture", folder / "model", phys_config=physics)
        )
    with run.stage("evaluate"):
        capture = Capture.open(folder / "capture", splits=(SPLIT,))
        evaluation = evaluate_model(read_model(folder / "model"), capture, SPLIT, device=run.device).result
    with run.stage("synthesize"):
        config = SynthesizeConfig(
            seed=run.seed, rollouts=run.rollouts, duration_s=SIZES[run.scene][1], plan=PLANS[run.scene]
        )
        config = config.model_copy(update={"device": run.device})
        summary = synthesize(folder / "model", folder / "dataset", config)
    with run.stage("check the rollouts"):
        check, poses = _checked(folder / "dataset", plan)
    result = WorldDemoResult(
        scene=run.scene,
        seed=run.seed,
        device=str(resolve_device(run.device)),
        verdict=_verdict(check),
        parameters=_compared(file.parameters, json.loads((folder / "capture" / TRUTH_FILE).read_text("utf-8"))),
        evaluation=evaluation,
        dataset=summary.model_copy(update={"dataset": "dataset"}),
        check=check,
        seconds=dict(run.seconds),
        paths={
            "report": REPORT_HTML,
            "figures": REPORT_JSON,
            "picture": PICTURE,
            "capture": "capture",
            "model": "model",
            "dataset": "dataset",
        },
        warnings=tuple(run.plain(message) for message in file.warnings),
        provenance=file.provenance,
    )
    _write(folder, plan, poses, result)
    return result


def _stated(run: _World, plan: WorldPlan) -> ModelFile:
    """Write the model of a capture that states the contact parameters of all pairs; only the shapes are fitted."""
    folder = run.folder
    fit(folder / "capture", folder / "shapes", stage="sg-gs")
    model = read_model(folder / "shapes")
    laws = start_laws(model.file, Capture.open(folder / "capture", check=False).manifest)
    numbers = [(pair, name) for pair in laws.pairs for name in _UNITS]
    file = model.file.model_copy(
        update={
            "contact": laws.contact,
            "pairs": laws.pairs,
            "solver": Solver(step_s=STATED_STEP_S, sweeps=CROWDED_SWEEPS),
            "parameters": (
                *model.file.parameters,
                *(
                    FittedParameter(
                        name=of_pair(name, pair.materials),
                        unit=_UNITS[name],
                        estimate=getattr(pair, name),
                        state="given",
                    )
                    for pair, name in numbers
                ),
            ),
        }
    )
    written = write_model(folder / "model", replace(model, file=file))
    rmtree(folder / "shapes")
    return written.file


def _write(folder: Path, plan: WorldPlan, poses: np.ndarray, result: WorldDemoResult) -> None:
    picture = world_picture(plan, poses)
    (folder / PICTURE).write_bytes(picture)
    (folder / REPORT_JSON).write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")
    (folder / REPORT_HTML).write_text(world_html(result, picture), encoding="utf-8")


def _checked(dataset: Path, plan: WorldPlan) -> tuple[RolloutCheck, np.ndarray]:
    """Judge the rollouts; return the result, and the poses (frames, bodies, 7) of the first one."""
    reader = RolloutReader(dataset)
    deepest, ends, escaped, first = 0.0, [], 0, np.zeros(0)
    for number in range(len(reader)):
        gaps, end = reader.read(number, "contacts/distance"), reader.read(number, "bodies/vel")[-1]
        place = reader.read(number, "bodies/pos")
        deepest = max(deepest, -float(gaps.min(initial=0.0)))
        ends.append(np.linalg.norm(end, axis=-1))
        escaped += bool(_outside(plan, place[-1]))
        if number == 0:
            first = np.concatenate([place, reader.read(number, "bodies/quat_wxyz")], -1)
    reader.close()
    speeds = np.concatenate(ends)
    return (
        RolloutCheck(
            rollouts=len(ends),
            deepest_m=deepest,
            at_rest=float((speeds < AT_REST_M_S).mean()),
            fastest_end_m_s=float(speeds.max()),
            escaped=escaped,
            labels_hold=validate(dataset).passed,
        ),
        first,
    )


def _outside(plan: WorldPlan, place: np.ndarray) -> bool:
    """Return whether a body is below the floor, or in the bin beyond its walls."""
    if plan.ground is not None:
        return bool((place[:, 2] < 0).any())
    reach = max(abs(x) for surface in plan.surfaces for x in surface.pose.position_m)
    return bool((place[:, 2] < 0).any() or (np.abs(place[:, :2]) > reach).any())


def _verdict(check: RolloutCheck) -> str:
    """Return what the check found, in words."""
    labels = "Their labels hold" if check.labels_hold else "cgwm validate finds faults in their labels"
    left = f"; a body left the scene in {check.escaped}" if check.escaped else ""
    return (
        f"{check.rollouts} rollouts: no penetration above {1e3 * check.deepest_m:.2f} mm at any frame; at the end "
        f"{100 * check.at_rest:.1f} % of the bodies are slower than {1e3 * AT_REST_M_S:g} mm/s, the fastest moves at "
        f"{1e3 * check.fastest_end_m_s:.1f} mm/s{left}. {labels}."
    )


def _compared(parameters: tuple[FittedParameter, ...], truth: dict[str, Any]) -> tuple[ComparedParameter, ...]:
    """Return the contact parameters of the pairs, with their true values."""
    true = {f"friction[{pair}]": float(value) for pair, value in truth["friction"].items()}
    for pair in truth["friction"]:
        true |= {f"contact_time_s[{pair}]": truth["natural_time_s"], f"damping_ratio[{pair}]": truth["damping_ratio"]}
    return tuple(_beside(p, true[p.name]) for p in parameters if p.name in true)


def _beside(parameter: FittedParameter, value: float) -> ComparedParameter:
    span = parameter.interval_95
    covered = None if span is None or parameter.state != "fitted" else bool(span[0] <= value <= span[1])
    return ComparedParameter(parameter=parameter, true_value=value, covered=covered)
