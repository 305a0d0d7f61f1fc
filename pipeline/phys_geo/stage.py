"""The stage phys-geo: fit the physics of a model to tracks or videos, then the appearance of the videos."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from ...datasets.capture.cameras import require_metric
from ...datasets.capture.capture import Capture
from ...datasets.capture.video import video_info
from ...datasets.io.progress import note
from ...datasets.models.joints import refuse_joints
from ...datasets.models.model import Model
from ...datasets.shapes.ply import Splats
from ...datasets.shapes.surfaces import stored
from ...schemas import (
    BodyModel,
    FitFile,
    FittedParameter,
    Ground,
    InputDataError,
    ModelFile,
    PhysConfig,
    Solver,
    UsageError,
)
from ...schemas.materials import pair_of
from ..physics.body import Body
from ..physics.chains.values import FACTORS, with_chain_values
from ..physics.effects.registry import effect_of
from ..physics.inertia import inertia_elements
from ..physics.model_world import world_of_model
from ..physics.rollout_cost import durations
from ..physics.world import World
from ..runtime.checkpoint import Checkpoint
from ..runtime.device import resolve_device
from ..runtime.work_budget import motion_doubt, within_budget
from ..segments.described_motion import not_described
from ..trajectories.frame_times import with_regular_times
from ..trajectories.observations import track_episodes
from .effects.requested_effects import fit_with_effects, fitted_effects, with_effects
from .material_pairs import start_laws, with_pusher_law
from .paper_setting import paper_config, unstable_sides
from .surface_starts import require_outside
from .tracks.contact_result import PhysicsFit
from .tracks.earlier_estimates import GROUND, EarlierEstimates
from .tracks.part_choice import SCALE
from .work import LESS, fit_parts

CROWDED_SWEEPS = 40
"""Sweeps over the contacts of a step where a body may touch several things at once. Of 64 drops of five objects into a
tray, 10 sweeps left bodies that stood on the floor and leaned on a wall rocking at 1 cm/s for good, 50 none; they cost
a tenth more time, since finding the contacts is most of it."""


def fit_motion(
    model: Model, capture: Capture, split: str, config: PhysConfig, checkpoint: Checkpoint, warnings: Sequence[str]
) -> Model:
    """Return the model with physics fitted to motion and, where there are videos, exposures and light.

    Args:
        model: The model to start from, with shapes of its bodies.
        capture: The capture.
        split: Name of the episodes to fit.
        config: The stage's settings.
        checkpoint: Checkpoint to which the poses found in videos are written.
        warnings: Warnings about the inputs, to which those of the fit are added.

    Raises:
        InputDataError: If no body is free, cameras are unscaled, or the episodes lack what is to be fitted.
        UsageError: If settings contradict each other.
        NotConvergedError: If the fit diverges.
    """
    _require_fittable(model, capture, config)
    if config.contact_law == "closed_form":
        capture = replace(capture, manifest=with_pusher_law(capture.manifest))
    else:
        config = paper_config(model.file, capture, config)
    ready = _with_surfaces(replace(model, file=_physics_start(model, capture, config)), capture)
    solver = ready.file.solver.model_copy(update={"sweeps": _sweeps(world_of_model(ready))})
    ready = replace(ready, file=ready.file.model_copy(update={"solver": solver}))
    if config.supervise == "tracks":
        warnings = (*warnings, *require_outside(world_of_model(ready), capture, split))
    started = time.perf_counter()
    found = _fitted_motion(ready, capture, split, config, checkpoint, model.file.contact is not None)
    found = replace(found, warnings=(*found.warnings, *found.record.unconverged(), *warnings))
    seconds = round(time.perf_counter() - started, 2)
    record = found.record.to_json() | {"seconds": seconds, "supervise": config.supervise}
    record |= {"warnings": list(found.warnings)}
    fitted = _merge(ready.file, world_of_model(ready), found)
    fit_file = FitFile(stages=ready.fit.stages | {"phys-geo": record})
    ready = replace(_with_collision(ready, found.collision), file=fitted, fit=fit_file, tracks=found.tracks)
    if config.contact_law == "paper":
        doubts = unstable_sides(world_of_model(ready))
        ready = replace(ready, file=ready.file.model_copy(update={"warnings": (*ready.file.warnings, *doubts)}))
    if config.supervise == "tracks" and not ready.file.articulations:
        free = {body.name for body in ready.file.bodies if body.motion == "free"}
        timed = with_regular_times(track_episodes(capture, split), free)[0]
        described = not_described(world_of_model(ready), timed, found.noise)
        ready = replace(ready, file=ready.file.model_copy(update={"not_described": described}))
    if ready.scene is not None and capture.cameras is not None and _has_video(capture, split):
        ready = _with_appearance(ready, capture, split, config, found)
    return ready


def _require_fittable(model: Model, capture: Capture, config: PhysConfig) -> None:
    """Refuse a model or a capture from whose motion no physics can be fitted."""
    asked = [name for name in ("mass_distribution", "length_scale") if getattr(config, name) is True]
    if asked:
        refuse_joints(model.file.articulations, str(capture.root), f"fit with phys-geo.{asked[0]}")
    uses_photos = any(name in model.body_splats for name in capture.body_names)
    if capture.cameras is not None and (uses_photos or config.supervise != "tracks"):
        require_metric(capture.cameras)
    if not model.file.tracked:
        raise InputDataError(
            f"{capture.root / 'capture.toml'}: no body is free, so no motion contains information about contact.",
            'motion = "free" for the body whose physics is wanted.',
            "write it under that body's [[bodies]], or fit the geometry alone: --stage sg-gs.",
        )


def _physics_start(model: Model, capture: Capture, config: PhysConfig) -> ModelFile:
    """Return the model file from which the fit of the physics starts."""
    effects = with_effects(model.file.effects, config.effects)
    laws = start_laws(model.file, capture.manifest)
    # warnings of an earlier fit of the physics do not apply to this one
    stale = set(model.fit.stages.get("phys-geo", {}).get("warnings", ()))
    return model.file.model_copy(
        update={
            "bodies": _of_materials(model.file.bodies, capture),
            "contact": laws.contact,
            "pairs": laws.pairs,
            # the ground of the capture, as an earlier fit may have moved the model's
            "ground": capture.manifest.world.ground or model.file.ground,
            "solver": Solver(contact_model=config.contact_law, step_s=config.step_s),
            "effects": effects,
            "warnings": tuple(text for text in model.file.warnings if text not in stale),
        }
    )


def _sweeps(world: World) -> int:
    """Return the number of sweeps over the contacts: more where a body may touch several things at once.

    With few, a body that leans on a wall and stands on a floor never comes to rest.
    """
    pairs = itertools.combinations(world.surfaces, 2)
    size = max((_diameter(world.bodies[k]) for k in world.tracked), default=0.0)
    crowded = len(world.tracked) > 1 or any(not one.apart(other, size) for one, other in pairs)
    return CROWDED_SWEEPS if crowded else Solver().sweeps


def _diameter(body: Body) -> float:
    """Return the diameter of a sphere about all colliding spheres of a body [m]."""
    if not body.radii.shape[-1]:
        return 0.0
    middle = body.centers[0].mean(0)
    return 2 * float(((body.centers[0] - middle).norm(dim=-1) + body.radii[0]).amax())


def _of_materials(bodies: Sequence[BodyModel], capture: Capture) -> tuple[BodyModel, ...]:
    """Return the bodies with the materials of the capture."""
    materials = {body.name: body.material for body in capture.manifest.bodies}
    return tuple(body.model_copy(update={"material": materials.get(body.name)}) for body in bodies)


def _with_surfaces(model: Model, capture: Capture) -> Model:
    """Return the model with the fixed surfaces of the capture, where it has any; an earlier model may lack them."""
    if not capture.manifest.surfaces:
        return model
    meshes = capture.surface_meshes()
    surfaces = tuple(stored(one, meshes.get(one.name), f"{one.name}.obj") for one in capture.manifest.surfaces)
    return replace(model, file=model.file.model_copy(update={"surfaces": surfaces}), surface_meshes=meshes)


def _fitted_motion(
    ready: Model, capture: Capture, split: str, config: PhysConfig, checkpoint: Checkpoint, warm_started: bool
) -> PhysicsFit:
    """Fit the physics to tracks or videos; `warm_started`: whether the contact parameters come from an earlier fit."""
    world = replace(world_of_model(ready), rolls_on=resolve_device(config.device).type)
    if config.supervise == "tracks":
        measured = capture.manifest.measurement
        noise = (measured.position_std_m, measured.rotation_std_rad)
        free = {body.name for body in ready.file.bodies if body.motion == "free"}
        episodes, clocked = with_regular_times(track_episodes(capture, split), free)
        spans = durations(episodes)
        with within_budget(fit_parts(world, spans, config), LESS, doubt=motion_doubt(spans)):
            kept = [p for p in ready.file.parameters if not p.name.endswith(FACTORS)]
            earlier = EarlierEstimates.of(kept, ready.file.correlations)
            medians = start_laws(ready.file, capture.manifest).medians
            found = fit_with_effects(
                world, episodes, config, noise, warm_started, capture.groups, earlier, medians, measured.force_std_n
            )
        unturned = {name: capture.checked_tracks(name).unturned for name in capture.episodes(split)}
        warnings = [text for text in (capture.unturned_warning(unturned),) if text]
        return replace(found, warnings=(*clocked, *found.warnings, *warnings))
    refuse_joints(ready.file.articulations, ready.place, f"fit with --supervise {config.supervise}")
    for name in ("mass_distribution", "length_scale"):
        if getattr(config, name) is True:
            raise UsageError(
                f"phys-geo.{name} with --supervise {config.supervise}: images do not identify it.",
                "--supervise tracks.",
                f"fit to tracks, or leave phys-geo.{name} at auto.",
            )
    from .images.image_fit import fit_physics_from_images

    spans = [max(_video_s(capture, name), 0.0) for name in capture.episodes(split)]
    with within_budget(fit_parts(world, spans, config), LESS, doubt=motion_doubt(spans)):
        return fit_physics_from_images(world, ready, capture, split, config, config.supervise == "both", checkpoint)


def _video_s(capture: Capture, episode: str) -> float:
    """Return the duration of the longest video of an episode [s], by the headers, without decoding; 0 without one."""
    rate_hz = capture.manifest.video.frame_rate_hz
    steps = [
        capture.frames_kept(camera, episode, video_info(capture.video_path(camera, episode)).frames) - 1
        for camera in capture.videos(episode)
    ]
    return max(steps, default=0) / rate_hz


def _with_appearance(model: Model, capture: Capture, split: str, config: PhysConfig, found: PhysicsFit) -> Model:
    """Return the model with the exposure of the video cameras and the light on the bodies."""
    from .images.exposure_time import with_durations
    from .images.lighting_fit import learn_appearance
    from .images.video_exposure import estimate_exposures

    note("phys-geo: exposure and light")
    exposures = estimate_exposures(model, capture, split, config.device)
    model = replace(model, file=model.file.model_copy(update={"exposures": exposures}))
    tracks = found.tracks if config.supervise == "images" else None  # measured ones are not used then
    model = learn_appearance(model, capture, exposures, split, tracks, config.device)
    return with_durations(model, capture, split, tracks, config.device)


def _with_collision(model: Model, moved: Mapping[str, Splats]) -> Model:
    """Return the model with moved collision spheres; where they are also the visual ones, both are moved."""
    shown = {name: spheres for name, spheres in moved.items() if model.collision[name] is model.body_splats.get(name)}
    return replace(model, collision=model.collision | dict(moved), body_splats=model.body_splats | shown)


def _has_video(capture: Capture, split: str) -> bool:
    """Return whether any episode of a split has a video."""
    return any(capture.videos(name) for name in capture.episodes(split))


def _merge(file: ModelFile, world: World, found: PhysicsFit) -> ModelFile:
    """Return the model file with the results of the fit in place of earlier ones."""
    fresh = {parameter.name for parameter in found.parameters}
    kept = [parameter for parameter in file.parameters if parameter.name not in fresh]
    correlations = [block for block in file.correlations if not fresh & set(block.parameters)]
    added = (SCALE,) if any(p.name.startswith(f"{SCALE}.") for p in found.parameters) else ()
    effects = with_effects(file.effects, added)
    own_values, spread = ({}, {}) if found.effects is None else (found.effects.own_values, found.effects.spread)
    file = _with_joints(file, world, found)
    return file.model_copy(
        update={
            "bodies": file.bodies if found.mass is None else _with_mass(file.bodies, found.mass.world),
            "contact": found.contact,
            "pairs": tuple(found.pairs.get(pair_of(*entry.materials), entry) for entry in file.pairs),
            "ground": _with_offset(file.ground, kept, found),
            "parameters": (*found.parameters, *kept),
            "correlations": (*found.correlations, *correlations),
            "effects": fitted_effects(
                effects,
                {e.name: effect_of(e).name for e in effects},
                found.parameters,
                found.constants,
                own_values,
                spread,
            ),
            "choice": found.record.choice,
            "measurement_std": {"position_m": found.noise.position_m, "rotation_rad": found.noise.rotation_rad},
            "warnings": tuple(dict.fromkeys((*file.warnings, *found.warnings))),
        }
    )


def _with_joints(file: ModelFile, world: World, found: PhysicsFit) -> ModelFile:
    """Return the model file with the fitted numbers of joints and links in its articulations and bodies."""
    if not file.articulations:
        return file
    values = {p.name: torch.tensor([p.estimate], dtype=torch.float64) for p in found.parameters}
    joints = {entry.name: entry for entry in file.articulations}
    for entry in file.articulations:
        moved = [
            joint.model_copy(
                update={
                    name: float(values[f"{joint.name}.{name}"])
                    for name in ("damping", "friction")
                    if f"{joint.name}.{name}" in values
                }
            )
            for joint in entry.joints
        ]
        joints[entry.name] = entry.model_copy(update={"joints": tuple(moved)})
    links = {body.name: body for body in with_chain_values(world, values).bodies if body.motion == "link"}
    bodies = [
        body.model_copy(
            update={
                "mass_kg": float(links[body.name].mass[0]),
                "inertia_kg_m2": inertia_elements(links[body.name].inertia[0].numpy()),
            }
        )
        if body.name in links
        else body
        for body in file.bodies
    ]
    return file.model_copy(update={"articulations": tuple(joints.values()), "bodies": tuple(bodies)})


def _with_offset(ground: Ground | None, kept: Sequence[FittedParameter], found: PhysicsFit) -> Ground | None:
    """Return the ground at the fitted height, or at one that an earlier fit has found."""
    earlier_m = next((p.estimate for p in kept if p.name == GROUND and p.state == "fitted"), None)
    offset_m = earlier_m if found.ground_offset_m is None else found.ground_offset_m
    return ground if ground is None or offset_m is None else ground.model_copy(update={"offset_m": offset_m})


def _with_mass(bodies: Sequence[BodyModel], world: World) -> tuple[BodyModel, ...]:
    """Return the bodies with the centres of mass and inertias that the free ones have in a world."""
    placed = {body.name: body for body in world.bodies}
    return tuple(
        body.model_copy(
            update={
                "com_m": tuple(placed[body.name].com[0].tolist()),
                "inertia_kg_m2": inertia_elements(placed[body.name].inertia[0].numpy()),
            }
        )
        if body.motion == "free"
        else body
        for body in bodies
    )
