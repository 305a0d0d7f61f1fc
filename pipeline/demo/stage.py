"""The demo (`cgwm demo`): make a scene, run every stage on it and write a report."""

from __future__ import annotations

import resource
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from ...datasets.capture.capture import Capture
from ...datasets.io.atomic import new_directory
from ...datasets.models.model import read_model
from ...datasets.rollouts.loader import RolloutReader
from ...datasets.synthetic import TRUTH_MESH, make_scene, read_truth
from ...schemas import (
    CalibrateConfig,
    CalibrationReport,
    DatasetSummary,
    DemoResult,
    ImagesOnlyFit,
    ModelFile,
    NotConvergedError,
    PhysConfig,
    SplatConfig,
    SynthesizeConfig,
)
from ..calibrate.stage import calibrate
from ..evaluate.evaluation import Evaluation
from ..evaluate.frame_strips import strips_of
from ..evaluate.stage import evaluate_model
from ..fit import fit
from ..rendering.contact_sheets import RolloutTile, contact_sheet, small_png, telling, tiles
from ..runtime.device import resolve_device
from ..runtime.timing import StagedRun
from ..synthesize.stage import synthesize
from .episode_section import curves_of
from .filmed_settings import FilmedSettings
from .page import REPORT_HTML, REPORT_JSON, ReportPictures, write_report
from .truth_tables import check_calibration, check_splats, compare_parameters
from .verdict import targets_of, verdict_text

ConfigT = TypeVar("ConfigT", CalibrateConfig, SplatConfig, PhysConfig, SynthesizeConfig)

SELECTION = {
    "fall": "The tosses are selected so that the measurement determines their outcome: the simulator itself, restarted "
    "with the errors of 0.1 s of measurement and with friction and damping off by a fifth and a tenth, repeats each of "
    "them closely. Tosses that balance on an edge before they fall to either side are excluded."
}
"""Explanation, for the report, of how a scene selects its episodes, if that makes them easier than arbitrary motion."""
WARMUP_S = 0.1
"""Length of the start of an episode that the model may see [s]."""
SPLIT = "test"
PICTURE = "demo.png"
_PICTURE_COLUMNS = 5
_PICTURE_TILE = 236
"""Width of a tile of the picture [px]."""
_ROLLOUTS_SHOWN = 8
_SHOWN_AT = 0.5
"""Fraction of a rollout at which its picture is taken: late enough that most have touched the ground."""


@dataclass(frozen=True, kw_only=True)
class DemoSettings(FilmedSettings):
    """Sizes and settings of the stages; the demo fills in seed and device."""

    photos: int = 48
    """Number of photos of the scene."""
    physics: PhysConfig = field(default_factory=PhysConfig)
    """Settings of the stage phys-geo."""
    images: PhysConfig = field(default_factory=lambda: PhysConfig(population=48, generations=5, iterations=6))
    """Settings of phys-geo from video frames alone: a shorter search than the default, because tracks from images are
    too noisy for a longer one to pay."""
    synthesize: SynthesizeConfig = field(default_factory=lambda: SynthesizeConfig(rollouts=8))
    """Settings of `synthesize`."""


@dataclass(frozen=True)
class _Demo(StagedRun):
    """A run of the demo and the settings that its stages share."""

    settings: DemoSettings
    """Sizes and settings of the stages."""
    seed: int
    """Seed of the scene and of every stage."""
    device: str
    """auto, cpu or cuda."""


def run_demo(
    out: Path,
    scene: str = "fall",
    seed: int = 0,
    renderer: str = "raycast",
    device: str = "auto",
    overwrite: bool = False,
    settings: DemoSettings | None = None,
) -> DemoResult:
    """Make a scene, calibrate, fit, synthesize, evaluate and report, each by the function that its command calls.

    Args:
        out: The directory to write; it appears once it is complete.
        scene: One of `datasets.synthetic.SCENES`.
        seed: Seed of the scene and of every stage.
        renderer: One of `datasets.synthetic.RENDERERS`.
        device: auto, cpu or cuda.
        overwrite: Replace what is at `out`.
        settings: Sizes and settings of the stages.

    Returns:
        The content of `report.json`.

    Raises:
        UsageError: If `out` exists, or a name is not allowed.
        NotConvergedError: If a stage fails; its message names the stage, and nothing is written.
    """
    resolve_device(device)  # refuse a wrong device now, not after minutes
    settings = settings or DemoSettings()
    with new_directory(Path(out), "demo", overwrite) as folder:
        demo = _Demo(folder, Path(out), settings, seed, device)
        return _run(demo, scene, renderer)


def _run(demo: _Demo, scene: str, renderer: str) -> DemoResult:
    settings, folder = demo.settings, demo.folder
    capture, dataset = folder / "capture", folder / "dataset"
    with demo.stage("make the scene"):
        sizes = {"photo_size": settings.photo_size, "video_size": settings.video_size, "photos": settings.photos}
        make_scene(scene, capture, demo.seed, renderer, **sizes)
    with demo.stage("calibrate"):
        calibration = calibrate(capture, _seeded(settings.calibrate, seed=demo.seed))
    with demo.stage("fit"):
        model = _fit(demo)
    with demo.stage("fit from images alone"):
        images_only = _fit_from_images(demo)
    with demo.stage("synthesize"):
        config = _seeded(settings.synthesize, seed=demo.seed, device=demo.device)
        summary = synthesize(folder / "model", dataset, config, preview=True)
    with demo.stage("evaluate"):
        evaluation = _evaluate(demo, "model", keep_frames=True)
        if images_only.outcome == "fitted":
            figures = _evaluate(demo, "model-images", brief=True).result
            images_only = images_only.model_copy(update={"evaluation": figures})
    with demo.stage("report"):
        result = _result(demo, (scene, renderer), calibration, model, images_only, summary, evaluation)
        _write(demo, result, evaluation)
    return result


def _fit(demo: _Demo) -> ModelFile:
    return fit(
        demo.folder / "capture",
        demo.folder / "model",
        splat_config=_seeded(demo.settings.splats, seed=demo.seed, device=demo.device),
        phys_config=_seeded(demo.settings.physics, seed=demo.seed, device=demo.device),
    )


def _fit_from_images(demo: _Demo) -> ImagesOnlyFit:
    """Fit the physics from the video frames alone; a failure is a result and does not stop the demo."""
    config = _seeded(demo.settings.images, seed=demo.seed, device=demo.device, supervise="images")
    try:
        model = fit(
            demo.folder / "capture",
            demo.folder / "model-images",
            stage="phys-geo",
            parent=demo.folder / "model",
            phys_config=config,
        )
    except NotConvergedError as error:
        return ImagesOnlyFit(outcome="not_converged", message=demo.plain(error.found))
    compared = compare_parameters(model.parameters, read_truth(demo.folder / "capture"))
    return ImagesOnlyFit(outcome="fitted", parameters=compared)


def _evaluate(demo: _Demo, model: str, *, keep_frames: bool = False, brief: bool = False) -> Evaluation:
    capture = Capture.open(demo.folder / "capture", splits=(SPLIT,))
    return evaluate_model(
        read_model(demo.folder / model), capture, SPLIT, WARMUP_S, demo.device, keep_frames=keep_frames, brief=brief
    )


def _result(
    demo: _Demo,
    made: tuple[str, str],
    calibration: CalibrationReport,
    file: ModelFile,
    images_only: ImagesOnlyFit,
    summary: DatasetSummary,
    evaluation: Evaluation,
) -> DemoResult:
    capture = demo.folder / "capture"
    truth = read_truth(capture)
    cameras = Capture.open(capture, check=False).cameras
    assert cameras is not None  # calibrate has written them
    targets = targets_of(evaluation.result)
    paths = {"report": REPORT_HTML, "figures": REPORT_JSON, "picture": PICTURE, "capture": "capture", "model": "model"}
    if images_only.outcome == "fitted":
        paths["model from images alone"] = "model-images"
    warnings = [f"calibrate: {message}" for message in calibration.warnings]
    warnings += [f"fit: {message}" for message in file.warnings]
    return DemoResult(
        scene=made[0],
        seed=demo.seed,
        renderer=made[1],
        device=str(resolve_device(demo.device)),
        verdict=verdict_text(evaluation.result, targets, WARMUP_S),
        targets=targets,
        evaluation=evaluation.result,
        selection=SELECTION.get(made[0], ""),
        parameters=compare_parameters(file.parameters, truth),
        images_only=images_only,
        calibration=check_calibration(calibration, cameras, truth),
        splats=check_splats(read_model(demo.folder / "model"), capture / TRUTH_MESH),
        dataset=summary.model_copy(update={"dataset": "dataset"}),
        curves=curves_of([episode.prediction for episode in evaluation.episodes], truth),
        seconds=dict(demo.seconds),
        peak_memory_bytes=_peak_memory_bytes(),
        paths={**paths, "dataset": "dataset"},
        warnings=tuple(demo.plain(message) for message in warnings),
        provenance=file.provenance,
    )


def _write(demo: _Demo, result: DemoResult, evaluation: Evaluation) -> None:
    """Write the report, its JSON and the picture for a README."""
    strips = strips_of(evaluation.episodes, Capture.open(demo.folder / "capture", check=False))
    write_report(demo.folder, result, ReportPictures(strips, _rollout_tiles(demo.folder / "dataset")))
    if strips:
        rows = tiles(strips[0], _PICTURE_TILE)
        chosen = telling(strips[0], _PICTURE_COLUMNS)
        (demo.folder / PICTURE).write_bytes(small_png(contact_sheet([frames[chosen] for frames in rows])))


def _rollout_tiles(dataset: Path) -> list[RolloutTile]:
    reader = RolloutReader(dataset)
    shown = []
    for number in range(min(_ROLLOUTS_SHOWN, len(reader))):
        cameras = reader.cameras(number)
        if not cameras:
            continue
        time_s = np.asarray(reader.read(number, "time"))
        frame = int(_SHOWN_AT * (len(time_s) - 1))
        image, depth, mask = (
            reader.read(number, f"obs/{cameras[0]}_{kind}", frame, frame + 1)[0] for kind in ("image", "depth", "mask")
        )
        shown.append(
            RolloutTile(
                rollout=reader.rollouts[number].index,
                time_s=float(time_s[frame]),
                image=image,
                depth_m=depth,
                mask=mask,
            )
        )
    reader.close()
    return shown


def _seeded(config: ConfigT, **values: object) -> ConfigT:
    return type(config).model_validate({**config.model_dump(), **values})


def _peak_memory_bytes() -> int:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak  # macOS counts bytes, Linux KiB
