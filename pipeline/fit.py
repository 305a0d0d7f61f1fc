"""`cgwm fit`: from a capture to a model, stage by stage."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ..datasets.capture.capture import Capture
from ..datasets.capture.links import articulation_models, articulations_of
from ..datasets.io.neighbours import clean_stale
from ..datasets.io.outputs import reads, refuse_output
from ..datasets.models.effect_files import effect_file
from ..datasets.models.finished import finished_model
from ..datasets.models.fit_inputs import input_hashes, motion_inputs, photo_inputs, versions
from ..datasets.models.model import Model, read_model, write_model
from ..datasets.shapes.surfaces import stored
from ..schemas import (
    Body,
    BodyModel,
    EffectModel,
    FitFile,
    FittedParameter,
    InputDataError,
    ModelFile,
    PhysConfig,
    Pose,
    Provenance,
    SplatConfig,
    UsageError,
    read_json,
)
from ..schemas.printable import typed_path
from .phys_geo.effects.requested_effects import with_effects
from .phys_geo.images.video_checks import examine_videos
from .phys_geo.material_pairs import require_known_pairs
from .phys_geo.stage import fit_motion
from .phys_geo.tracks.earlier_estimates import with_fitted_physics
from .physics.effects.trust import is_trusted, keep_trust
from .physics.inertia import inertia_elements, symmetric
from .runtime.checkpoint import Checkpoint
from .runtime.device import resolve_device
from .runtime.resources import enough_memory
from .sg_gs.collision.collision_spheres import fills_hull
from .sg_gs.stage import SgGsResult, fit_scene

Stage = Literal["all", "sg-gs", "phys-geo"]

ASSUMED_DENSITY_KG_M3 = 500.0
"""Density assumed for a body without a given mass; free motion and contact with the ground do not depend on it."""


@reads("capture")
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
    accept_units: bool = False,
) -> ModelFile:
    """Fit a capture stage by stage and write the model.

    Args:
        capture: The capture's directory.
        out: The model's directory; it appears when the fit is complete.
        stage: `sg-gs` (shape and appearance), `phys-geo` (contact, needs a shape or `parent`), or `all` for which the
            capture has inputs.
        parent: A model to start from; it is not changed.
        split: Name of the episodes to fit.
        splat_config: Settings of sg-gs.
        phys_config: Settings of phys-geo.
        overwrite: Replace an existing model.
        resume: Continue an interrupted fit of the same model, if there is one; keep a finished model that was made of
            the same inputs with the same settings.
        accept_units: Do not refuse units and frames that the motion contradicts; the model records it.

    Returns:
        The content of `model.json`.

    Raises:
        UsageError: If `out` exists, or the split does not; with `resume`, if `out` was made of other inputs.
        InputDataError: If the capture lacks what the stage needs.
        NotConvergedError: If the fit diverges; nothing is written then.
        NotEnoughMemoryError: If there is not enough memory.
    """
    model, _ = fit_or_keep(
        capture, out, stage, parent, split, splat_config, phys_config, overwrite, resume, accept_units
    )
    return model


@reads("capture")
def fit_or_keep(
    capture: Path,
    out: Path,
    stage: Stage = "all",
    parent: Path | None = None,
    split: str = "train",
    splat_config: SplatConfig | None = None,
    phys_config: PhysConfig | None = None,
    overwrite: bool = False,
    resume: bool = False,
    accept_units: bool = False,
) -> tuple[ModelFile, bool]:
    """Fit as :func:`fit` does; return `model.json`, and whether a model of the same inputs and settings was kept."""
    splat_config, phys_config, out = splat_config or SplatConfig(), phys_config or PhysConfig(), Path(out)
    clean_stale(out)
    if (out / "model.json").is_file() and not (resume or overwrite):
        with suppress(UsageError, InputDataError):  # another model: it exists, and that is said below
            return _fit_or_keep(
                capture, out, stage, parent, split, splat_config, phys_config, False, True, accept_units
            )
    return _fit_or_keep(capture, out, stage, parent, split, splat_config, phys_config, overwrite, resume, accept_units)


def _fit_or_keep(
    capture: Path,
    out: Path,
    stage: Stage,
    parent: Path | None,
    split: str,
    splat_config: SplatConfig,
    phys_config: PhysConfig,
    overwrite: bool,
    resume: bool,
    accept_units: bool,
) -> tuple[ModelFile, bool]:
    finished = resume and (out / "model.json").is_file()
    if not finished:
        refuse_output(out, "model", overwrite)
    _refuse_early(stage, phys_config)
    accept_units = accept_units or _accepts_units(parent)
    moving = stage == "phys-geo" or (stage == "all" and (phys_config.effects != () or not _photos_alone(capture)))
    opened = Capture.open(capture, splits=(split,) if moving else (), accept_units=accept_units)
    started = time.perf_counter()
    request = _Request(
        capture=opened,
        out=out,
        stage=stage,
        parent=parent,
        split=split,
        splat_config=splat_config,
        phys_config=phys_config,
        accept_units=accept_units,
    )
    made_of = {} if stage == "phys-geo" else photo_inputs(opened, splat_config)  # phys-geo alone makes no spheres
    if moving:
        made_of |= motion_inputs(opened, parent if stage == "phys-geo" else None, split, phys_config)
    provenance = _provenance(request, made_of)
    if finished and (kept := finished_model(out, provenance, overwrite)) is not None:
        _complete(request, kept.effects, made_of)
        return kept, True
    refuse_output(out, "model", overwrite)
    checkpoint = Checkpoint.beside(out, made_of, resume, overwrite)
    moves = stage == "phys-geo" or (moving and _has_motion(opened, split))
    # pairs that nobody gave, and videos that identify nothing, are reported before hours of work
    if moves:
        require_known_pairs(opened, split)
    warnings = [*opened.inconsistencies, *_video_warnings(request)] if moves else []
    model = _fitted_model(request, checkpoint, moves, warnings)
    provenance = provenance.model_copy(update={"input_sha256": _with_sources(provenance, model.file.effects)})
    stages = model.fit.stages | {"total": {"seconds": round(time.perf_counter() - started, 2)}}
    file = model.file.model_copy(update={"provenance": provenance})
    fit_file = FitFile(stages=stages, warnings=file.warnings)
    written = write_model(out, replace(model, file=file, fit=fit_file), overwrite)
    _complete(request, model.file.effects, made_of)
    return written.file, False


def _refuse_early(stage: Stage, config: PhysConfig) -> None:
    """Refuse effects that cannot be fitted, before hours of work."""
    with_effects((), config.effects)
    if config.effects and stage == "sg-gs":
        raise UsageError(
            "--effects with --stage sg-gs: effects are fitted to motion.", "--stage phys-geo or all.", "leave one out."
        )


def _complete(request: _Request, effects: Sequence[EffectModel], made_of: Mapping[str, str]) -> None:
    """Do what follows the model, which may have been left out if the process was killed between the two."""
    keep_trust(effect for effect in effects if effect.sha256 is not None and is_trusted(effect.sha256))
    Checkpoint.remove_of(request.out, made_of)


@dataclass(frozen=True, kw_only=True)
class _Request:
    """Arguments of a fit."""

    capture: Capture
    """The opened capture."""
    out: Path
    """Directory of the new model."""
    stage: Stage
    """Stage, or `all`."""
    parent: Path | None
    """Directory of the model to start from."""
    split: str
    """Name of the episodes to fit."""
    splat_config: SplatConfig
    """Settings of sg-gs."""
    phys_config: PhysConfig
    """Settings of phys-geo."""
    accept_units: bool
    """Whether the capture's units are right although its motion contradicts them."""


def _accepts_units(parent: Path | None) -> bool:
    """Return whether the model to start from was fitted with `--accept-units`."""
    if parent is None or not (parent / "model.json").is_file():
        return False  # what is missing is reported when the model is read
    return bool(read_json(parent / "model.json", ModelFile).provenance.config.get("accept_units", False))


def _video_warnings(request: _Request) -> list[str]:
    """Return warnings about the videos that are to be fitted."""
    if request.phys_config.supervise == "tracks":
        return []
    return examine_videos(request.capture, request.split, request.phys_config.supervise == "both")


def _fitted_model(request: _Request, checkpoint: Checkpoint, moves: bool, warnings: Sequence[str]) -> Model:
    """Run the stages and return their model; `moves`: whether there is motion for phys-geo."""
    splat_config, phys_config = request.splat_config, request.phys_config
    with enough_memory(*_needs(splat_config)):
        model = _start(request.capture, request.stage, request.parent, splat_config, checkpoint)
    if moves:
        with enough_memory(*_needs(phys_config)):
            return fit_motion(model, request.capture, request.split, phys_config, checkpoint, warnings)
    if phys_config.effects:
        raise InputDataError(
            f"{request.capture.root}: --effects, but split '{request.split}' has no motion to fit them to.",
            "tracks or videos of its episodes.",
            "add tracks/<episode>.csv, name another split with --split, or leave --effects out.",
        )
    return model


def _provenance(request: _Request, made_of: Mapping[str, str]) -> Provenance:
    """Return the inputs, settings and versions from which the model is made."""
    effects = tuple(request.phys_config.effects)
    return Provenance(
        capture=request.capture.root.resolve().name,
        input_sha256=input_hashes(request.capture, request.split, request.parent, effects, made_of),
        versions=versions(),
        seed=request.phys_config.seed,
        # a relative path stays valid when both models are moved together
        parent=None if request.parent is None else os.path.relpath(request.parent, request.out.parent),
        config={
            "stage": request.stage,
            "split": request.split,
            "sg-gs": request.splat_config.model_dump(mode="json"),
            "phys-geo": request.phys_config.model_dump(mode="json"),
        }
        | ({"accept_units": True} if request.accept_units else {}),
    )


def _with_sources(provenance: Provenance, effects: Sequence[EffectModel]) -> dict[str, str]:
    """Return the hashes of the inputs, with those of the effects by their names in the model."""
    files = {name: digest for name, digest in provenance.input_sha256.items() if effect_file(name) is None}
    return files | {effect.name: effect.sha256 for effect in effects if effect.sha256 is not None}


def _needs(config: SplatConfig | PhysConfig) -> tuple[str, str, str]:
    """Return a stage's sizes that need memory, its device, and the advice for using less."""
    device = resolve_device(config.device).type
    if isinstance(config, SplatConfig):
        scene = config.max_scene_spheres if config.spheres is None else config.spheres
        tried = f"{scene} spheres of the background, {config.max_body_spheres} a body, photos at {config.image_size} px"
        less = "--spheres N" if config.spheres is not None else "--set sg-gs.max_scene_spheres=N"
        return tried, device, f"fewer spheres ({less}), smaller photos (--set sg-gs.image_size=N)"
    population = "a population of 24 to 96" if config.population is None else f"a population of {config.population}"
    return f"{population}, supervised by {config.supervise}", device, "--set phys-geo.population=N with a smaller N"


def _start(capture: Capture, stage: Stage, parent: Path | None, config: SplatConfig, checkpoint: Checkpoint) -> Model:
    """Return the model from which the physics starts: the parent, or a new one from the stage sg-gs."""
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
                f"leave --from out, or run 'cgwm fit {typed_path(capture.root)} --out MODEL' first.",
            )
        if stage == "phys-geo":
            return model
        fresh = _from_scene(capture, fit_scene(capture, config, checkpoint))
        return replace(fresh, file=with_fitted_physics(fresh.file, model.file))
    if stage == "phys-geo":
        lacking = [body.name for body in capture.manifest.bodies if body.shape is None and body.motion != "link"]
        if lacking:
            raise InputDataError(
                f"{capture.root / 'capture.toml'}: body '{lacking[0]}' has no shape, and physics needs one.",
                "shape = { box | sphere | mesh | splats }, or a model with spheres from photos.",
                f"run 'cgwm fit {typed_path(capture.root)} --stage all --out MODEL', or pass --from MODEL.",
            )
    return _from_scene(capture, fit_scene(capture, config, checkpoint))


def _from_scene(capture: Capture, scene: SgGsResult) -> Model:
    """Return a model from the result of the stage sg-gs, without fitted physics."""
    bodies, warnings = [], list(scene.warnings)
    for body in capture.manifest.bodies:
        found = scene.bodies[body.name]
        mass = body.mass_kg or ASSUMED_DENSITY_KG_M3 * found.mass_properties.volume_m3
        inertia = symmetric(body.inertia_kg_m2) if body.inertia_kg_m2 else mass * found.mass_properties.inertia_m2
        bodies.append(
            BodyModel(
                name=body.name,
                motion=body.motion,
                mass_kg=mass,
                inertia_kg_m2=inertia_elements(inertia),
                com_m=body.com_m or _three(found.mass_properties.com_m),
                photo_pose=found.photo_pose or Pose(),
                shape=body.shape,
                material=body.material,
                face_points=body.face_points,
                face_exponent=body.face_exponent,
                collision_distance_m=found.collision_distance_m,
                radius_factor=scene.radius_factor,
                convex=fills_hull(
                    np.asarray(found.collision.means, float),
                    scene.radius_factor * np.asarray(found.collision.scales, float),
                    found.mass_properties.volume_m3,
                ),
            )
        )
    world = capture.manifest.world
    meshes = capture.surface_meshes()
    file = ModelFile(
        gravity_m_s2=world.gravity_m_s2,
        ground=world.ground,
        bodies=tuple(bodies),
        articulations=articulation_models(capture.manifest, articulations_of(capture.root, capture.manifest)),
        surfaces=tuple(stored(one, meshes.get(one.name), f"{one.name}.obj") for one in capture.manifest.surfaces),
        parameters=tuple(
            p
            for body, fitted in zip(capture.manifest.bodies, bodies, strict=True)
            for p in _mass_parameters(body, fitted)
        ),
        ground_shadow=scene.ground_shadow,
        first_view=scene.first_view,
        warnings=tuple(warnings),
        provenance=Provenance(capture=capture.root.name),
    )
    return Model(
        root=None,
        file=file,
        body_splats={name: body.visual for name, body in scene.bodies.items() if body.visual is not None},
        collision={name: body.collision for name, body in scene.bodies.items()},
        surface_meshes=meshes,
        scene=scene.scene,
        fit=FitFile(stages={"sg-gs": scene.record}),
        cameras=scene.cameras,
        pictures=scene.pictures,
    )


def _mass_parameters(body: Body, fitted: BodyModel) -> list[FittedParameter]:
    """Return mass and centre of mass with their source; neither is fitted to the motion."""
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
        FittedParameter(
            name=f"{body.name}.mass_kg",
            unit="kg",
            estimate=fitted.mass_kg,
            state="given" if given else "not_observable",
            note=note,
        )
    ]
    source = "given" if body.com_m is not None else "derived"
    rows += [
        FittedParameter(
            name=f"{body.name}.com_{axis}_m",
            unit="m",
            estimate=value,
            state=source,
            note="" if source == "given" else "from the shape, at uniform density",
        )
        for axis, value in zip("xyz", fitted.com_m, strict=True)
    ]
    return rows


def _photos_alone(root: Path) -> bool:
    """Return whether a capture has photos and no place for motion, so that there are no episodes to name."""
    return (root / "images").is_dir() and not any((root / kind).exists() for kind in ("tracks", "videos"))


def _has_motion(capture: Capture, split: str) -> bool:
    """Return whether any episode of a split has tracks or videos."""
    if split not in capture.manifest.splits:
        return False
    episodes = capture.episodes(split)
    return any(capture.tracks(name) or capture.videos(name) for name in episodes)


def _three(vector: np.ndarray) -> tuple[float, float, float]:
    """Return a vector (3,) as a tuple."""
    x, y, z = (float(value) for value in vector)
    return x, y, z
