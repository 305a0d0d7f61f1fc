"""Shared inputs of all rollouts of a shard: model, resolved plan, cameras, simulator and renderer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from ...datasets.capture.cameras import Camera
from ...datasets.io.atomic import sha256
from ...datasets.models.model import Model, read_model
from ...datasets.rollouts.shards import shard_range
from ...schemas import DatasetManifest, InputDataError, ModelFile, SamplingPlan, SynthesizeConfig, UsageError
from ..physics.model_world import world_of_model
from ..rendering.ground_shadow import shadow_of
from ..rendering.label_renderer import LabelRenderer
from ..runtime.device import resolve_device
from ..runtime.work_budget import within_budget
from .parameters import DERIVED, not_varied, require_admissible, with_correlations
from .plan import resolve_plan
from .rejection import Rejection
from .simulator import Simulator
from .viewpoints import look_at_cameras
from .wholes import require_startable
from .work import LESS, shard_parts, synthesis_parts

STATE_ONLY = (
    "state only: the model has no visual spheres, so there is nothing to render; "
    "obs/ holds the bodies' state and no images"
)
RECORDED_PACKAGES = ("cgwm", "h5py", "hdf5plugin", "mujoco", "numpy", "torch")
_ENDLESS_SHARDS_S = 366 * 86400.0
"""Duration of all shards of a dataset from which it is refused [s]: several machines may share them."""
NOT_CONTENT = {"shard", "batch"}
"""Settings that do not affect the content of rollouts."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """Shared inputs of all rollouts of a shard."""

    model: Model
    """The fitted model."""
    config: SynthesizeConfig
    """Settings of the dataset."""
    plan: SamplingPlan
    """The resolved plan."""
    times_s: np.ndarray
    """Times of the frames [s], shape (T,)."""
    cameras: Mapping[str, Camera]
    """Cameras by name; empty for a model without visual spheres."""
    renderer: LabelRenderer | None
    """Renderer of the labels; None for a model without visual spheres."""
    simulator: Simulator
    """Simulator of the rollouts."""
    rejection: Rejection
    """Rules that reject rollouts."""
    device: str
    """Device of simulation and rendering: cpu or cuda."""


def resolved_plan(model: Path, plan: SamplingPlan) -> SamplingPlan:
    """Return a plan with its missing entries filled in for a model.

    Args:
        model: MODEL.
        plan: The plan.

    Raises:
        InputDataError: If `model` is no model or has no fitted physics, or the plan does not fit it.
    """
    return _with_plan(model, plan)[1]


def _with_plan(path: Path, plan: SamplingPlan) -> tuple[Model, SamplingPlan]:
    model = read_model(path)
    require_startable(model)
    lacking = [body.name for body in model.file.bodies if body.name not in model.collision]
    if lacking:
        raise InputDataError(
            f"{path}: the body '{lacking[0]}' has no colliding spheres.",
            todo="fit it again: cgwm fit CAPTURE --out MODEL.",
        )
    if model.file.contact is None:
        world_of_model(model)  # raises an error that names missing physics
    model = replace(model, file=with_correlations(model))
    require_admissible(model.file, plan.parameters, plan.source)
    return model, resolve_plan(model, plan)


def prepared(path: Path, config: SynthesizeConfig, out: Path | None = None) -> Job:
    """Read the model and prepare the shared inputs of all rollouts.

    Args:
        path: MODEL.
        config: The settings.
        out: Where the shard will be written, if it will.

    Raises:
        InputDataError: If `path` is no model, has no fitted physics, or the plan does not fit it.
        UsageError: If the settings cannot be met, or this machine cannot finish the work.
    """
    model, plan = _with_plan(path, config.plan)
    count = round(config.duration_s * config.frame_rate_hz) + 1
    if count < 2:
        raise UsageError(
            f"{config.duration_s:g} s at {config.frame_rate_hz:g} frames/s is one frame.",
            "two frames or more.",
            "raise synthesize.duration_s or synthesize.frame_rate_hz.",
        )
    device = str(resolve_device(config.device))
    visible = bool(model.body_splats)
    if plan.reject.unseen_share is not None and not visible:
        raise InputDataError(
            f"{path}: the model has no visual spheres, so that no camera sees it, and the plan has unseen_share.",
            todo="leave unseen_share out of [reject].",
        )
    rollouts = len(shard_range(config.rollouts, config.shards, config.shard))
    with within_budget(synthesis_parts(model, plan, config, rollouts, device, config.batch or 1), LESS, out):
        return _job(model, plan, config, device, count)


def _job(model: Model, plan: SamplingPlan, config: SynthesizeConfig, device: str, count: int) -> Job:
    """Allocate what all rollouts of a shard share."""
    cameras = look_at_cameras(model, plan, config) if model.body_splats else {}
    renderer = LabelRenderer(model, cameras, device) if model.body_splats else None
    if config.shadows:
        _require_shadow(model)
    times = np.arange(count) / config.frame_rate_hz
    simulator, rejection = Simulator(model, times, device), Rejection.of(model, plan.reject)
    return Job(
        model=model,
        config=config,
        plan=plan,
        times_s=times,
        cameras=cameras,
        renderer=renderer,
        simulator=simulator,
        rejection=rejection,
        device=device,
    )


def _require_shadow(model: Model) -> None:
    """Refuse shadows that the model cannot cast.

    Raises:
        InputDataError: If no lamp is known, or no ground can be seen.
    """
    lacking = (
        "no body has visual spheres" if not model.body_splats
        else "it has no background" if model.scene is None
        else "neither its photos nor its videos tell where the lamp is" if shadow_of(model.file) is None
        else None
    )  # fmt: skip
    if lacking is not None:
        raise InputDataError(
            f"{model.root}: synthesize.shadows is set, and no shadow can be cast: {lacking}.",
            todo="leave synthesize.shadows out, or fit the model from photos with a cast shadow or from videos.",
        )


@contextmanager
def checked_work(path: Path, config: SynthesizeConfig, workers: int) -> Iterator[None]:
    """Refuse a dataset of several shards that this machine cannot finish; shards already there are counted, too.

    Args:
        path: MODEL.
        config: The settings.
        workers: Number of shards made at a time.

    Raises:
        UsageError: If it cannot, with the numbers.
    """
    model, plan = _with_plan(path, config.plan)
    device = str(resolve_device(config.device))
    parts = synthesis_parts(model, plan, config, config.rollouts, device, config.batch or 1)
    with within_budget(shard_parts(parts, config.shards, workers), LESS, endless_s=_ENDLESS_SHARDS_S):
        yield


def manifest_of(path: Path, job: Job, notes: tuple[str, ...]) -> DatasetManifest:
    """Return the manifest of the dataset, without shards."""
    settings = job.config.model_copy(update={"plan": job.plan, "shard": 0})
    return DatasetManifest(
        model_sha256=sha256(path),
        config=settings.model_dump(mode="json", exclude=NOT_CONTENT),
        rollouts=job.config.rollouts,
        shard_count=job.config.shards,
        bodies=tuple(body.name for body in job.model.file.bodies),
        cameras=tuple(job.cameras),
        versions={name: version(name) for name in RECORDED_PACKAGES} | {"rollout_engine": job.simulator.engine},
        notes=notes,
    )


def notes_of(job: Job) -> tuple[str, ...]:
    """Return the notes on the rollouts for the user."""
    notes = [] if job.renderer is not None else [STATE_ONLY]
    if job.plan.parameter_spread > 0:
        notes += _parameter_notes(job.model.file)
    if job.plan.light_turn_deg.support != (0.0, 0.0) and job.model.file.light is None:
        notes.append("light_turn_deg turns nothing: the model has no light")
    unseen = [b.name for b in job.model.file.bodies if b.name not in job.model.body_splats]
    if job.renderer is not None and unseen:
        notes.append(f"not in the images, because they have no visual spheres: {', '.join(unseen)}")
    return tuple(notes)


def _parameter_notes(file: ModelFile) -> list[str]:
    """Return the notes on physical parameters that are not drawn, or not drawn jointly, in a plan with a spread."""
    notes = []
    kept = not_varied(file)
    if kept:
        notes.append(f"kept at their estimate, because nothing sets them in a rollout: {', '.join(kept)}")
    spread = [p.name for p in file.parameters if p.std_error and p.name not in kept]
    if not spread:
        notes.append("no physical parameter has a standard error, so all rollouts have the same physics")
    together = {name for block in file.correlations for name in block.parameters}
    alone = [name for name in spread if name not in together and name not in DERIVED]
    if len(alone) > 1:
        notes.append(f"drawn each by itself, because the model has no correlations of them: {', '.join(alone)}")
    return notes
