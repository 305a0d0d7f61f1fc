"""`cgwm fit`: from a capture to a model, stage by stage."""

from __future__ import annotations

import importlib.metadata
import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from ..datasets.atomic import refuse_existing, sha256
from ..datasets.cameras import require_metric
from ..datasets.capture import Capture
from ..datasets.colmap_model import find_colmap_model
from ..datasets.geometry_maps import KINDS
from ..datasets.models import Model, read_model, write_model
from ..datasets.ply import Splats
from ..schemas import (
    Body,
    BodyModel,
    ContactParameters,
    EffectModel,
    FitFile,
    InputDataError,
    ModelFile,
    Parameter,
    PhysConfig,
    Pose,
    Provenance,
    Solver,
    SplatConfig,
    UsageError,
)
from .checkpoint import Checkpoint
from .fit_effects import fit_with_effects, fitted_effects, with_effects
from .memory import enough_memory
from .phys_geo import PhysicsFit, track_episodes
from .physics.effects.registry import load_effect
from .physics.world import World, symmetric
from .sfm.points import POINTS_NAME
from .sg_gs import SgGsResult, fit_scene, resolve_device
from .video_checks import examine_videos

Stage = Literal["all", "sg-gs", "phys-geo"]

ASSUMED_DENSITY_KG_M3 = 500.0
"""Stands in for a mass that is not given; free motion and contact with the ground do not depend on it."""


def fit(
    capture: Path,
    out: Path,
    stage: Stage = "all",
    parent: Path | None = None,
    split: str = "train",
    splat_config: SplatConfig | None = None,
    phys_config: PhysConfig | None = None,
    overwrite: bool = False,
    resume: bool = False,
) -> ModelFile:
    """Fit a capture and write the model.

    Args:
        capture: The capture's directory.
        out: The model's directory; it appears when the fit is complete.
        stage: `sg-gs` (shape and looks), `phys-geo` (contact, needs a shape or `parent`), or all that the capture has
            inputs for.
        parent: A model to start from; it is not changed.
        split: The episodes to fit.
        splat_config: Settings of sg-gs.
        phys_config: Settings of phys-geo.
        overwrite: Replace an existing model.
        resume: Go on with a fit of the same model that was interrupted, if there is one.

    Returns:
        What stands in `model.json`.

    Raises:
        UsageError: If `out` exists, or the split does not.
        InputDataError: If the capture lacks what the stage needs.
        NotConvergedError: If the fit diverges; nothing is written then.
        NotEnoughMemoryError: If the memory does not suffice.
    """
    splat_config, phys_config = splat_config or SplatConfig(), phys_config or PhysConfig()
    refuse_existing(out, overwrite)
    with_effects((), phys_config.effects)  # a name that is wrong is told before hours of work
    if phys_config.effects and stage == "sg-gs":
        raise UsageError(
            "--effects with --stage sg-gs: effects are fitted to motion.", "--stage phys-geo or all.", "leave one out."
        )
    opened = Capture.open(capture, splits=(split,) if stage != "sg-gs" else ())
    started = time.perf_counter()
    config = {"sg-gs": splat_config.model_dump(mode="json"), "phys-geo": phys_config.model_dump(mode="json")}
    # phys-geo alone makes no spheres, so that the photos need not be read for their hashes
    made_of = {} if stage == "phys-geo" else _made_of(opened, splat_config)
    if stage != "sg-gs":
        made_of |= _physics_made_of(opened, stage, parent, split, phys_config)
    checkpoint = Checkpoint.beside(Path(out), made_of, resume, overwrite)
    moves = stage == "phys-geo" or (stage == "all" and _has_motion(opened, split))
    # what videos cannot teach is told before hours of work
    warnings = (
        examine_videos(opened, split, phys_config.supervise == "both")
        if moves and phys_config.supervise != "tracks"
        else []
    )
    with enough_memory(*_needs(splat_config)):
        model = _start(opened, stage, parent, splat_config, checkpoint)
    if moves:
        with enough_memory(*_needs(phys_config)):
            model = _with_physics(model, opened, split, phys_config, checkpoint, warnings)
    elif phys_config.effects:
        raise InputDataError(
            f"{opened.root}: --effects, but split '{split}' has no motion to fit them to.",
            "tracks or videos of its episodes.",
        )
    provenance = Provenance(
        capture=opened.root.resolve().name,
        input_sha256=_input_hashes(opened, split, model.file.effects),
        versions=_versions(),
        seed=phys_config.seed,
        # relative, so that models which are moved together still know each other
        parent=None if parent is None else os.path.relpath(parent, Path(out).parent),
        config={"stage": stage, "split": split, **config},
    )
    stages = model.fit.stages | {"total": {"seconds": round(time.perf_counter() - started, 2)}}
    file = model.file.model_copy(update={"provenance": provenance})
    fit_file = FitFile(stages=stages, warnings=file.warnings)
    written = write_model(out, replace(model, file=file, fit=fit_file), overwrite)
    checkpoint.remove()
    return written.file


def _needs(config: SplatConfig | PhysConfig) -> tuple[str, str, str]:
    """Return what takes a stage's memory, the device, and what would take less."""
    device = resolve_device(config.device).type
    if isinstance(config, SplatConfig):
        scene = config.max_scene_spheres if config.spheres is None else config.spheres
        tried = f"{scene} spheres of the background, {config.max_body_spheres} a body, photos at {config.image_size} px"
        less = "--spheres N" if config.spheres is not None else "--set sg-gs.max_scene_spheres=N"
        return tried, device, f"fewer spheres ({less}), smaller photos (--set sg-gs.image_size=N)"
    population = "a population of 24 to 96" if config.population is None else f"a population of {config.population}"
    return f"{population}, supervised by {config.supervise}", device, "--set phys-geo.population=N with a smaller N"


def _made_of(capture: Capture, config: SplatConfig) -> dict[str, str]:
    """Return what the spheres are made of, so that checkpoints of anything else are refused."""
    root, colmap = capture.root, find_colmap_model(capture.root)
    names = ("images", "masks", *KINDS, "capture.toml", "cameras.json", "transforms.json", POINTS_NAME)
    shapes = [file for body in capture.manifest.bodies if (file := capture.shape_file(body)) is not None]
    paths = [root / name for name in names] + ([] if colmap is None else [colmap]) + shapes
    inputs = {path.relative_to(root).as_posix(): sha256(path) for path in paths if path.exists()}
    return {"settings": config.model_dump_json(), "versions": json.dumps(_versions()), **inputs}


def _physics_made_of(
    capture: Capture, stage: Stage, parent: Path | None, split: str, config: PhysConfig
) -> dict[str, str]:
    """Return what the physics is made of, so that checkpoints of anything else are refused."""
    made = {"physics settings": config.model_dump_json(), "split": split}
    if stage == "phys-geo" and parent is not None and (parent / "model.json").is_file():
        made["parent model"] = sha256(parent / "model.json")
    if config.supervise == "tracks" or split not in capture.manifest.splits:
        return made
    for name in ("capture.toml", "cameras.json"):
        if (capture.root / name).is_file():
            made[name] = sha256(capture.root / name)
    for episode in capture.episodes(split):
        for camera in capture.videos(episode):
            made[f"video {camera}/{episode}"] = sha256(capture.video_path(camera, episode))
    return made


def _start(capture: Capture, stage: Stage, parent: Path | None, config: SplatConfig, checkpoint: Checkpoint) -> Model:
    """Return the model that the physics starts from: the parent's, or a new one from the stage sg-gs."""
    if not capture.manifest.bodies and stage == "phys-geo":
        raise InputDataError(
            f"{capture.root / 'capture.toml'}: no [[bodies]], so there is nothing whose physics could be fitted.",
            todo="describe the body: [[bodies]] with a name.",
        )
    if parent is not None:
        model = read_model(parent)
        names = [body.name for body in model.file.bodies]
        if names != capture.body_names:
            raise InputDataError(
                f"{parent}: its bodies are {names}, those of {capture.root} are {capture.body_names}.",
                "a model of this capture's bodies.",
            )
        if stage == "phys-geo":
            return model
        fresh = _from_scene(capture, fit_scene(capture, config, checkpoint))
        return replace(fresh, file=fresh.file.model_copy(update={"effects": model.file.effects}))
    if stage == "phys-geo":
        lacking = [body.name for body in capture.manifest.bodies if body.shape is None]
        if lacking:
            raise InputDataError(
                f"{capture.root / 'capture.toml'}: body '{lacking[0]}' has no shape, and physics needs one.",
                "shape = { box | sphere | mesh | splats }, or a model with spheres from photos.",
                f"run 'cgwm fit {capture.root} --stage all --out MODEL', or pass --from MODEL.",
            )
    return _from_scene(capture, fit_scene(capture, config, checkpoint))


def _from_scene(capture: Capture, scene: SgGsResult) -> Model:
    bodies, warnings = [], list(scene.warnings)
    for body in capture.manifest.bodies:
        found = scene.bodies[body.name]
        mass = body.mass_kg or ASSUMED_DENSITY_KG_M3 * found.mass_properties.volume_m3
        inertia = (
            _six(symmetric(body.inertia_kg_m2)) if body.inertia_kg_m2 else _six(mass * found.mass_properties.inertia_m2)
        )
        bodies.append(
            BodyModel(
                name=body.name,
                motion=body.motion,
                mass_kg=mass,
                inertia_kg_m2=inertia,
                com_m=body.com_m or _three(found.mass_properties.com_m),
                photo_pose=found.photo_pose or Pose(),
                shape=body.shape,
                collision_distance_m=found.collision_distance_m,
                radius_factor=scene.radius_factor,
            )
        )
    world = capture.manifest.world
    file = ModelFile(
        gravity_m_s2=world.gravity_m_s2,
        ground=world.ground,
        bodies=tuple(bodies),
        parameters=tuple(
            p
            for body, fitted in zip(capture.manifest.bodies, bodies, strict=True)
            for p in _mass_parameters(body, fitted)
        ),
        warnings=tuple(warnings),
        provenance=Provenance(capture=capture.root.name),
    )
    return Model(
        None,
        file,
        {name: body.visual for name, body in scene.bodies.items() if body.visual is not None},
        {name: body.collision for name, body in scene.bodies.items()},
        scene.scene,
        FitFile(stages={"sg-gs": scene.record}),
        scene.cameras,
        scene.pictures,
    )


def _mass_parameters(body: Body, fitted: BodyModel) -> list[Parameter]:
    """Say where mass and centre of mass come from; neither is fitted to the motion."""
    if body.motion != "free":
        return []
    given = body.mass_kg is not None
    note = (
        ""
        if given
        else (
            f"assumed density {ASSUMED_DENSITY_KG_M3:g} kg/m3; weigh the body, or record a collision with a known one"
        )
    )
    rows = [
        Parameter(
            name=f"{body.name}.mass_kg",
            unit="kg",
            estimate=fitted.mass_kg,
            state="given" if given else "not_observable",
            note=note,
        )
    ]
    source = "given" if body.com_m is not None else "derived"
    rows += [
        Parameter(
            name=f"{body.name}.com_{axis}_m",
            unit="m",
            estimate=value,
            state=source,
            note="" if source == "given" else "from the shape, at uniform density",
        )
        for axis, value in zip("xyz", fitted.com_m, strict=True)
    ]
    return rows


def _has_motion(capture: Capture, split: str) -> bool:
    if split not in capture.manifest.splits:
        return False
    episodes = capture.episodes(split)
    return any(capture.tracks(name) or capture.videos(name) for name in episodes)


def _with_physics(
    model: Model, capture: Capture, split: str, config: PhysConfig, checkpoint: Checkpoint, warnings: Sequence[str]
) -> Model:
    uses_photos = any(name in model.body_splats for name in capture.body_names)
    if capture.cameras is not None and (uses_photos or config.supervise != "tracks"):
        require_metric(capture.cameras)
    if not any(body.motion == "free" for body in model.file.bodies):
        raise InputDataError(
            f"{capture.root / 'capture.toml'}: no body is free, so no motion tells about contact.",
            'motion = "free" for the body whose physics is wanted.',
        )
    effects = with_effects(model.file.effects, config.effects)
    # what an earlier fit of the physics warned of is not true of this one
    stale = set(model.fit.stages.get("phys-geo", {}).get("warnings", ()))
    start = model.file.model_copy(
        update={
            "contact": model.file.contact or ContactParameters(),
            # one that an earlier fit moved would hide what moved it
            "ground": capture.manifest.world.ground or model.file.ground,
            "solver": Solver(step_s=config.step_s),
            "effects": effects,
            "warnings": tuple(text for text in model.file.warnings if text not in stale),
        }
    )
    ready = replace(model, file=start)
    world = replace(World.from_model(ready), rolls_on=resolve_device(config.device).type)
    started = time.perf_counter()
    if config.supervise == "tracks":
        measured = capture.manifest.measurement
        noise = (measured.position_std_m, measured.rotation_std_rad)
        episodes, begun = track_episodes(capture, split), model.file.contact is not None
        found = fit_with_effects(world, episodes, config, noise, begun, capture.groups)
    elif config.mass_distribution:
        raise UsageError(
            f"phys-geo.mass_distribution with --supervise {config.supervise}: images do not show where the mass is.",
            "--supervise tracks.",
            "fit to tracks, or leave phys-geo.mass_distribution at false.",
        )
    else:
        from .phys_images import fit_physics_from_images

        both = config.supervise == "both"
        found = fit_physics_from_images(world, ready, capture, split, config, both, checkpoint)
    found = replace(found, warnings=(*found.warnings, *warnings))
    record = found.record | {"seconds": round(time.perf_counter() - started, 2), "supervise": config.supervise}
    record |= {"warnings": list(found.warnings)}
    fitted = _merge(start, found)
    fit_file = FitFile(stages=ready.fit.stages | {"phys-geo": record})
    ready = replace(_with_collision(ready, found.collision), file=fitted, fit=fit_file, tracks=found.tracks)
    if ready.scene is not None and capture.cameras is not None and _has_video(capture, split):
        from .appearance import learn_appearance
        from .exposure import estimate_exposures

        exposures = estimate_exposures(ready, capture, split, config.device)
        ready = replace(ready, file=fitted.model_copy(update={"exposures": exposures}))
        # with images alone measured tracks are not to be looked at
        ready = learn_appearance(
            ready, capture, exposures, split, found.tracks if config.supervise == "images" else None
        )
    return ready


def _with_collision(model: Model, moved: Mapping[str, Splats]) -> Model:
    """Return the model with colliding spheres that were moved; where they are the visual ones, both move."""
    shown = {name: spheres for name, spheres in moved.items() if model.collision[name] is model.body_splats.get(name)}
    return replace(model, collision=model.collision | dict(moved), body_splats=model.body_splats | shown)


def _has_video(capture: Capture, split: str) -> bool:
    return any(capture.videos(name) for name in capture.episodes(split))


def _merge(file: ModelFile, found: PhysicsFit) -> ModelFile:
    fresh = {parameter.name for parameter in found.parameters}
    kept = [parameter for parameter in file.parameters if parameter.name not in fresh]
    correlations = [block for block in file.correlations if not fresh & set(block.parameters)]
    ground = file.ground
    if ground is not None and found.ground_offset_m is not None:
        ground = ground.model_copy(update={"offset_m": found.ground_offset_m})
    bodies = file.bodies
    if found.mass is not None:
        placed = {body.name: body for body in found.mass.world.bodies}
        bodies = tuple(
            body.model_copy(
                update={
                    "com_m": _three(placed[body.name].com[0].numpy()),
                    "inertia_kg_m2": _six(placed[body.name].inertia[0].numpy()),
                }
            )
            if body.motion == "free"
            else body
            for body in bodies
        )
    return file.model_copy(
        update={
            "bodies": bodies,
            "contact": found.contact,
            "ground": ground,
            "parameters": (*found.parameters, *kept),
            "correlations": (*found.correlations, *correlations),
            "effects": fitted_effects(
                file.effects,
                {e.name: load_effect(e.name).name for e in file.effects},
                found.parameters,
                found.constants,
                {} if found.effects is None else found.effects.own,
                {} if found.effects is None else found.effects.spread,
            ),
            "measurement_std": {"position_m": found.noise[0], "rotation_rad": found.noise[1]},
            "warnings": tuple(dict.fromkeys((*file.warnings, *found.warnings))),
        }
    )


def _input_hashes(capture: Capture, split: str, effects: Sequence[EffectModel]) -> dict[str, str]:
    names = ["capture.toml", "cameras.json"]
    if split in capture.manifest.splits:
        names += [f"tracks/{episode}.csv" for episode in capture.episodes(split)]
    files = {name: capture.root / name for name in names}
    files |= {effect.name: Path(effect.name.partition(":")[0]) for effect in effects if ".py:" in effect.name}
    return {name: sha256(path) for name, path in files.items() if path.is_file()}


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in ("cgwm", "torch", "numpy", "scipy")}


def _six(matrix: np.ndarray) -> tuple[float, float, float, float, float, float]:
    xx, yy, zz, xy, xz, yz = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    return xx, yy, zz, xy, xz, yz


def _three(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z
