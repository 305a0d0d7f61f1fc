"""The scene control (`cgwm demo --scene control`): photos and one video, a fit from them, and pushes to a pose."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ...datasets.io.atomic import new_directory
from ...datasets.synthetic import make_scene, plan_scene, read_truth
from ...datasets.synthetic.dynamics import FINGERTIP, FINGERTIP_RADIUS
from ...datasets.synthetic.objects import write_parts
from ...schemas import (
    CalibrationReport,
    ControlDemoResult,
    ControlResult,
    ControlTask,
    ModelFile,
    PhysConfig,
    SlowPlansError,
    task_toml,
)
from ..calibrate.stage import calibrate
from ..control.page import FILM
from ..control.stage import control
from ..fit import fit
from ..runtime.device import resolve_device
from ..runtime.timing import StagedRun
from .control_page import REPORT_HTML, REPORT_JSON, control_demo_html
from .filmed_settings import FilmedSettings
from .truth_tables import compare_parameters

TASK, TRUTH, RUNS = "push.toml", "true_parts", "runs"
SHOWN = ("friction", "contact_time_s", "damping_ratio", "ground_offset_m")
"""Parameters that the report compares with the truth, where the fit has them."""


@dataclass(frozen=True, kw_only=True)
class ControlDemoSettings(FilmedSettings):
    """Sizes and settings of the stages; the demo fills in seed and device."""

    photos: int = 32
    """Number of photos of the scene."""
    physics: PhysConfig = field(
        default_factory=lambda: PhysConfig(supervise="images", population=48, generations=5, iterations=6)
    )
    """Settings of phys-geo from the video frames alone."""
    runs: int = 3
    """Number of runs."""
    timeout_s: float = 60.0
    """Time after which a run has failed [s]."""


@dataclass(frozen=True)
class _Demo(StagedRun):
    """A run of the demo and the settings that its stages share."""

    settings: ControlDemoSettings
    """Sizes and settings of the stages."""
    seed: int
    """Seed of the scene and of every stage."""
    device: str
    """auto, cpu or cuda."""


def run_control_demo(
    out: Path,
    seed: int = 0,
    device: str = "auto",
    overwrite: bool = False,
    settings: ControlDemoSettings | None = None,
) -> ControlDemoResult:
    """Photograph an object, film one push, fit a model to both, and push the object to a pose with it, in MuJoCo.

    Args:
        out: The directory to write; it appears once it is complete.
        seed: Seed of the scene and of every stage.
        device: auto, cpu or cuda.
        overwrite: Replace what is at `out`.
        settings: Sizes and settings of the stages.

    Returns:
        The content of `report.json`.

    Raises:
        UsageError: If `out` exists, or the seed is not allowed.
        NotConvergedError: If a stage fails; its message names the stage, and nothing is written.
    """
    resolve_device(device)  # refuse a wrong device now, not after minutes
    plan_scene("push", seed)
    with new_directory(Path(out), "demo", overwrite) as folder:
        return _run(_Demo(folder, Path(out), settings or ControlDemoSettings(), seed, device))


def _run(demo: _Demo) -> ControlDemoResult:
    settings, folder = demo.settings, demo.folder
    with demo.stage("make the scene"):
        sizes = {"photo_size": settings.photo_size, "video_size": settings.video_size, "photos": settings.photos}
        make_scene("push", folder / "capture", demo.seed, splits=("train",), **sizes)
        _write_task(demo)
    with demo.stage("calibrate"):
        config = settings.calibrate.model_copy(update={"seed": demo.seed})
        calibration = calibrate(folder / "capture", config)
    with demo.stage("fit"):
        seeded = {"seed": demo.seed, "device": demo.device}
        file = fit(
            folder / "capture",
            folder / "model",
            splat_config=settings.splats.model_copy(update=seeded),
            phys_config=settings.physics.model_copy(update=seeded),
        )
    with demo.stage("control"):
        found, slow = _pushed(demo)
    result = _result(demo, calibration, file, found, slow)
    (folder / REPORT_JSON).write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")
    film = folder / RUNS / FILM
    page = control_demo_html(result, film.read_bytes() if film.is_file() else b"")
    (folder / REPORT_HTML).write_text(page, encoding="utf-8")
    return result


def _pushed(demo: _Demo) -> tuple[ControlResult, list[str]]:
    """Run the task; with the ideal clock where plans take too long here, with a warning that says so."""
    model, task, out = demo.folder / "model", demo.folder / TASK, demo.folder / RUNS
    try:
        return control(model, task, out, seeds=demo.settings.runs, device="cpu"), []
    except SlowPlansError as error:
        found = control(model, task, out, clock="ideal", seeds=demo.settings.runs, device="cpu")
        return found, [f"control: {error.found} The runs are with the ideal clock, in which plans act at once."]


def _write_task(demo: _Demo) -> None:
    """Write the task and, for its plant, the true convex parts with the true numbers, which the fit never sees."""
    folder, plan = demo.folder, plan_scene("push", demo.seed)
    (folder / TRUTH).mkdir()
    parts = write_parts(folder / TRUTH, plan.solid)
    contact = read_truth(folder / "capture").contact
    task = ControlTask.model_validate(
        {
            "robot": {"name": FINGERTIP, "radius_m": FINGERTIP_RADIUS},
            "success": {"timeout_s": demo.settings.timeout_s},
            "plant": {
                "kind": "mujoco",
                "meshes": [f"{TRUTH}/{name}" for name in parts],
                "friction": contact.friction,
                "finger_friction": contact.friction_fingertip,
                "mass_kg": plan.solid.mass,
            },
        }
    )
    (folder / TASK).write_text(task_toml(task), encoding="utf-8")


def _result(
    demo: _Demo, calibration: CalibrationReport, file: ModelFile, found: ControlResult, slow: list[str]
) -> ControlDemoResult:
    truth = read_truth(demo.folder / "capture")
    warnings = [f"calibrate: {words}" for words in calibration.warnings] + [f"fit: {words}" for words in file.warnings]
    warnings += slow + [f"control: {words}" for words in (*found.warnings, *([found.advice] if found.advice else []))]
    return ControlDemoResult(
        seed=demo.seed,
        device=str(resolve_device(demo.device)),
        family=truth.object.family,
        verdict=found.sentence,
        parameters=tuple(one for one in compare_parameters(file.parameters, truth) if one.parameter.name in SHOWN),
        control=found.model_copy(update={"model": "model", "task": TASK}),
        seconds=dict(demo.seconds),
        paths={
            "report": REPORT_HTML,
            "figures": REPORT_JSON,
            "capture": "capture",
            "model": "model",
            "task": TASK,
            "true shape": TRUTH,
            "runs": RUNS,
        },
        warnings=tuple(demo.plain(words) for words in warnings),
        provenance=file.provenance,
    )
