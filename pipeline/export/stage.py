"""The stage export (`cgwm export`): a dataset or a model in the format of another tool."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial import KDTree

from ...datasets.capture.cameras import read_cameras
from ...datasets.capture.capture import Capture
from ...datasets.exports.bop import write_bop
from ...datasets.exports.bop_models import ObjectModel
from ...datasets.exports.colmap import write_colmap
from ...datasets.exports.glb import write_glb
from ...datasets.exports.lerobot import write_lerobot
from ...datasets.exports.mesh_glb import write_mesh_glb
from ...datasets.exports.nerfstudio import MaskUse, place_of, write_nerfstudio
from ...datasets.exports.rerun_log import require_rerun, write_rerun
from ...datasets.exports.sdf import write_sdf
from ...datasets.exports.selection import Selection
from ...datasets.exports.splat_files import in_world, write_splat_files
from ...datasets.exports.urdf import write_urdf
from ...datasets.exports.usd import require_usd, usd_text
from ...datasets.io.atomic import new_file
from ...datasets.io.kinds import Kind, kind_of, refuse_other_kind
from ...datasets.io.outputs import DirectoryKind, FileKind, may_repeat, reads, refuse_output
from ...datasets.io.progress import note, progress
from ...datasets.models.mjcf import softer_pairs, write_mjcf
from ...datasets.models.model import Model, read_model
from ...schemas import ExportFormat, ExportResult, InputDataError, UsageError
from ...schemas.printable import typed_path
from ...schemas.quantities import MOST_DURATION_S
from .soundness import require_sound, require_sound_files

DATASET_FORMATS: tuple[ExportFormat, ...] = ("lerobot", "bop", "nerfstudio", "rerun")
MODEL_FORMATS: tuple[ExportFormat, ...] = ("mjcf", "urdf", "sdf", "usd", "ply", "colmap", "glb", "mesh")
SUFFIXES: dict[ExportFormat, str] = {"mjcf": ".xml", "usd": ".usda", "glb": ".glb", "mesh": ".glb", "rerun": ".rrd"}
"""Suffixes of the formats that are single files."""
LEAST_DURATION_S = 0.02
"""Shortest motion that is compared with MuJoCo [s]: two of its frames."""

LEROBOT_NOTES = (
    "videos are lossy; keep the HDF5 files as the original",
    "depth, masks and contacts are omitted; cameras and parameters are in meta/cgwm.json",
)
BOP_NOTE = "the objects' meshes are the surfaces of their collision spheres"
NERFSTUDIO_NOTE = (
    "time runs from 0 to 1; nerfstudio keeps the metres with --orientation-method none --center-method none "
    "--auto-scale-poses False"
)
RERUN_NOTE = "pictures are JPEG and depth has steps of 1 mm; distortion of cameras, forces and parameters are left out"
MESH_NOTE = "the meshes are the surfaces of the collision spheres, in the colours of the nearest visual spheres"
NO_TURNING = "in the .ply and .glb the bodies keep the light of the photos, whatever their orientation"
NO_START = "the model has jointed bodies: the MJCF has no start, and no motion of it was compared, only places of links"
URDF_NOTE = "a URDF has no contact law and no pose of what moves freely; each body and each jointed body has a file"
SDF_NOTE = (
    "SDF has friction and restitution of collisions, which simulators combine each in its way, but no contact time"
)
USD_NOTE = "USD has friction and restitution of materials, but no contact time: simulators choose their own stiffness"
SOFT_FRICTION = (
    "friction in MuJoCo is softer than Coulomb's law: slip decays within one contact time; thrown cubes were 4 to 10 "
    "mm (median) off 0.1 s after the first contact, slippery ones most"
)
SOFTER_PAIRS = (
    "{first} and {second} have too many pairs of collision spheres: between them slip decays with the time constant of "
    "solref, which is longer"
)
NO_DRIVEN = "driven bodies are mocap bodies, whose velocity MuJoCo's friction ignores"


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of an export; each format takes some of them (see :data:`OPTIONS`)."""

    split: str | None = None
    """Only the rollouts of `mask/<split>`."""
    cameras: tuple[str, ...] | None = None
    """Only these cameras of the dataset."""
    every: int = 1
    """Every n-th frame."""
    task: str | None = None
    """Task description for LeRobot."""
    rollout: int = 0
    """Global index of the rollout."""
    mask: MaskUse = "none"
    """Which pixels nerfstudio's masks keep."""
    sh_degree: int = 0
    """Degree of spherical harmonics to which the .ply is padded."""
    capture: Path | None = None
    """The capture with the photos and their cameras."""
    seed: int = 0
    """Seed of the start of the comparison with MuJoCo."""
    duration_s: float = 1.0
    """Length of that comparison [s]."""


OPTIONS: dict[ExportFormat, tuple[str, ...]] = {
    "lerobot": ("split", "cameras", "every", "task"),
    "bop": ("split", "cameras", "every"),
    "nerfstudio": ("rollout", "cameras", "every", "mask"),
    "rerun": ("rollout", "cameras", "every"),
    "mjcf": ("seed", "duration_s"),
    "urdf": ("seed",),
    "sdf": ("seed",),
    "usd": ("seed",),
    "ply": ("sh_degree",),
    "colmap": ("capture",),
    "glb": (),
    "mesh": (),
}
"""Options that each format takes."""

Facts = dict[str, int | float | str]

_KINDS: dict[ExportFormat, DirectoryKind | FileKind] = {
    "lerobot": "LeRobot dataset",
    "bop": "BOP dataset",
    "nerfstudio": "nerfstudio capture",
    "rerun": "Rerun recording",
    "mjcf": "MJCF file",
    "urdf": "URDF folder",
    "sdf": "SDF folder",
    "usd": "USD file",
    "ply": "splat file",
    "colmap": "COLMAP model",
    "glb": "glTF file",
    "mesh": "glTF file",
}
"""What each format writes; `ply` without that suffix writes a folder."""


@reads("thing")
def export(
    thing: Path, format_: ExportFormat, out: Path, options: ExportOptions | None = None, overwrite: bool = False
) -> ExportResult:
    """Write a dataset or a model in another format.

    Args:
        thing: DATASET for lerobot, bop, nerfstudio and rerun; MODEL for mjcf, urdf, sdf, usd, ply, colmap, glb
            and mesh.
        format_: The format.
        out: The file (.xml, .usda, .glb, .ply, .rrd) or directory to write; it appears once it is complete.
        options: Options of the format.
        overwrite: Replace what exists.

    Raises:
        InputDataError: If `thing` is of another kind, or lacks data that the format needs.
        UsageError: If `out` exists, or an option names something that does not exist.
    """
    thing, out, chosen = Path(thing), Path(out), options or ExportOptions()
    _refuse_kind(thing, format_)
    suffix = SUFFIXES.get(format_)
    if suffix and out.suffix.lower() != suffix:
        raise UsageError(
            f"--out {out}: --to {format_} writes one file.",
            f"a name that ends in {suffix}.",
            "choose a name with that ending.",
        )
    kind = "splat folder" if format_ == "ply" and out.suffix.lower() != ".ply" else _KINDS[format_]
    refuse_output(out, kind, overwrite or may_repeat(out, kind))
    facts, notes = _WORK[format_](thing, out, chosen, overwrite)
    return ExportResult(source=str(thing), format=format_, out=str(out), facts=facts, notes=tuple(notes))


def _refuse_kind(thing: Path, format_: ExportFormat) -> None:
    wanted: Kind = "dataset" if format_ in DATASET_FORMATS else "model"
    found = kind_of(thing)
    if found is not None and found != wanted:
        raise InputDataError(
            f"{thing} is a {found}; --to {format_} takes a {wanted}.",
            f"for a dataset: {', '.join(DATASET_FORMATS)}; for a model: {', '.join(MODEL_FORMATS)}.",
            "name one, or choose another format with --to.",
        )
    refuse_other_kind(thing, wanted)


def _lerobot(thing: Path, out: Path, options: ExportOptions, overwrite: bool) -> tuple[Facts, list[str]]:
    chosen = _selected(thing, options)
    folder = thing / chosen.manifest.model
    require_sound(chosen, read_model(folder) if folder.exists() else None)
    return write_lerobot(out, chosen, options.task, overwrite), [*chosen.notes, *LEROBOT_NOTES]


def _bop(thing: Path, out: Path, options: ExportOptions, overwrite: bool) -> tuple[Facts, list[str]]:
    chosen = _selected(thing, options)
    model = read_model(thing / chosen.manifest.model)
    require_sound(chosen, model)
    meshes = {name: object_model(model, name) for name in chosen.bodies()}
    counts, notes = write_bop(out, chosen, meshes, overwrite)
    return {**counts}, [*chosen.notes, BOP_NOTE, *notes]


def _nerfstudio(thing: Path, out: Path, options: ExportOptions, overwrite: bool) -> tuple[Facts, list[str]]:
    chosen = _selected(thing, options)
    require_sound(chosen, read_model(thing / chosen.manifest.model), [place_of(chosen, options.rollout)])
    return write_nerfstudio(out, chosen, options.rollout, options.mask, overwrite), [*chosen.notes, NERFSTUDIO_NOTE]


def _rerun(thing: Path, out: Path, options: ExportOptions, overwrite: bool) -> tuple[Facts, list[str]]:
    require_rerun()
    chosen = _selected(thing, options)
    require_sound(chosen, read_model(thing / chosen.manifest.model), [place_of(chosen, options.rollout)])
    return write_rerun(out, chosen, options.rollout, overwrite), [*chosen.notes, RERUN_NOTE]


def _selected(thing: Path, options: ExportOptions) -> Selection:
    """Return what is exported of a dataset whose files can be listed."""
    require_sound_files(thing)
    return Selection(thing, options.split, options.cameras, options.every)


def _mjcf(thing: Path, out: Path, options: ExportOptions, overwrite: bool) -> tuple[Facts, list[str]]:
    from .mujoco_check import AFTER_CONTACT_S, keyframe_of, link_deviation, resimulate, start_of

    if not LEAST_DURATION_S <= options.duration_s <= MOST_DURATION_S:
        raise UsageError(
            f"--duration {options.duration_s:g} s.",
            f"{LEAST_DURATION_S:g} to {MOST_DURATION_S:g} s.",
            "pass a duration in seconds.",
        )
    model = _simulated(thing)
    if model.file.articulations:
        text = write_mjcf(model, source=f"cgwm, of {model.file.provenance.capture}")
        away_mm, away_deg = link_deviation(model, text, options.seed)
        with new_file(out, "MJCF file", overwrite) as temporary:
            temporary.write_text(text, encoding="utf-8")
        return {"deviation_of_links_mm": away_mm, "deviation_of_links_deg": away_deg}, [NO_START]
    note("export: the same motion in MuJoCo")
    start = start_of(model, options.seed, options.duration_s)
    text = write_mjcf(model, keyframe=keyframe_of(start), source=f"cgwm, of {model.file.provenance.capture}")
    away = resimulate(model, text, start, options.duration_s)
    with new_file(out, "MJCF file", overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8")
    facts: Facts = {"duration_s": away.duration_s}
    if away.first_contact_s is not None:
        facts["first_contact_s"] = away.first_contact_s
    after = f"{AFTER_CONTACT_S:g}_s_after_contact"
    for name, part in (("in_flight", away.flight), (f"until_{after}", away.impact), ("at_the_end", away.end)):
        if part is not None:
            facts |= {f"deviation_{name}_mm": part[0], f"deviation_{name}_deg": part[1]}
    notes = [f"the effect {effect.name} is not in the MJCF" for effect in model.file.effects]
    notes += [SOFTER_PAIRS.format(first=first, second=second) for first, second in softer_pairs(model)]
    notes += [NO_DRIVEN] if any(body.motion == "driven" for body in model.file.bodies) else []
    return facts, [*notes, SOFT_FRICTION] if away.impact is not None else notes


def _urdf(thing: Path, out: Path, options: ExportOptions, overwrite: bool) -> tuple[Facts, list[str]]:
    from .urdf_check import urdf_deviation

    model = _simulated(thing)
    facts: Facts = {}

    def check(folder: Path) -> None:
        facts["deviation_of_links_mm"], facts["deviation_of_links_deg"] = urdf_deviation(model, folder, options.seed)

    counts = write_urdf(out, model, _surfaces_of_bodies(model), check, overwrite)
    return {**counts, **facts}, [URDF_NOTE, *_left_out(model, "URDF"), *_lost_of_joints(model, "URDF")]


def _sdf(thing: Path, out: Path, options: ExportOptions, overwrite: bool) -> tuple[Facts, list[str]]:
    from .sdf_check import sdf_deviation
    from .usd_check import restitutions

    model = _simulated(thing)
    facts: Facts = {}

    def check(root: ET.Element) -> None:
        facts["deviation_of_links_mm"], facts["deviation_of_links_deg"] = sdf_deviation(model, root, options.seed)

    counts = write_sdf(out, model, _surfaces_of_bodies(model), restitutions(model), check, overwrite)
    notes = [SDF_NOTE, *_left_out(model, "SDF"), *_mixed_pairs(model, "SDF"), *_lost_of_joints(model, "SDF")]
    if any(body.motion == "driven" for body in model.file.bodies):
        notes.append("driven bodies are kinematic: what moves them is not in the SDF")
    return {**counts, **facts}, notes


def _usd(thing: Path, out: Path, options: ExportOptions, overwrite: bool) -> tuple[Facts, list[str]]:
    from .usd_check import restitutions, usd_deviation

    require_usd()
    model = _simulated(thing)
    text, counts = usd_text(model, _surfaces_of_bodies(model), restitutions(model))
    away_mm, away_deg = usd_deviation(model, text, options.seed)
    with new_file(out, "USD file", overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8")
    notes = [USD_NOTE, *_left_out(model, "USD"), *_mixed_pairs(model, "USD")]
    if any(joint.friction or joint.armature for one in model.file.articulations for joint in one.joints):
        notes.append("dry friction and reflected inertia of joints are not in the USD")
    return {**counts, "deviation_of_links_mm": away_mm, "deviation_of_links_deg": away_deg}, notes


def _left_out(model: Model, name: str) -> list[str]:
    return [f"the effect {effect.name} is not in the {name}" for effect in model.file.effects]


def _mixed_pairs(model: Model, name: str) -> list[str]:
    if all(pair.materials[0] == pair.materials[1] for pair in model.file.pairs):
        return []
    return [f"friction of pairs of different materials is not in the {name}, which combines that of single ones"]


def _lost_of_joints(model: Model, name: str) -> list[str]:
    notes = []
    if any(one.servos for one in model.file.articulations):
        notes.append(f"gains of servos are not in the {name}, their torque limits are (effort)")
    if any(joint.armature for one in model.file.articulations for joint in one.joints):
        notes.append(f"the reflected inertia of joints (armature) is not in the {name}")
    return notes


def _surfaces_of_bodies(model: Model) -> dict[str, ObjectModel]:
    """Return the surface of the collision spheres of each body that has some, by name."""
    return {
        body.name: object_model(model, body.name)
        for body in progress(model.file.bodies, "export: meshes", unit="body")
        if body.name in model.collision and len(model.collision[body.name])
    }


def _ply(thing: Path, out: Path, options: ExportOptions, overwrite: bool) -> tuple[Facts, list[str]]:
    model = _visible(thing)
    if not 0 <= options.sh_degree <= 3:
        raise UsageError(
            f"--sh-degree {options.sh_degree}: not a degree of harmonics.", "0 to 3.", "pass one of these degrees."
        )
    counts = write_splat_files(out, model, options.sh_degree, overwrite)
    return {f"{name}_spheres": count for name, count in counts.items()}, _light_notes(model)


def _glb(thing: Path, out: Path, options: ExportOptions, overwrite: bool) -> tuple[Facts, list[str]]:
    model = _visible(thing)
    counts = write_glb(out, model, overwrite)
    return {f"{name}_spheres": count for name, count in counts.items()}, _light_notes(model)


def _mesh(thing: Path, out: Path, options: ExportOptions, overwrite: bool) -> tuple[Facts, list[str]]:
    model = read_model(thing)
    surfaces = _surfaces_of_bodies(model)
    if not surfaces:
        todo = "fit it to photos: cgwm fit CAPTURE --out MODEL."
        raise InputDataError(f"{thing}: no body has collision spheres, whose surface the mesh is.", todo=todo)
    counts = write_mesh_glb(out, model, surfaces, overwrite)
    grey = [name for name in surfaces if name not in model.body_splats]
    notes = [f"{name} is grey: it has no visual spheres" for name in grey]
    return {f"{name}_triangles": count for name, count in counts.items()}, [MESH_NOTE, *notes, *_light_notes(model)]


def _colmap(thing: Path, out: Path, options: ExportOptions, overwrite: bool) -> tuple[Facts, list[str]]:
    model, capture = _visible(thing), options.capture
    # cameras refined by the fit take precedence over those of the capture
    cameras = model.cameras
    if cameras is None and capture is not None:
        cameras = read_cameras(Capture.open(capture, check=False).root)
    if cameras is None or not cameras.images:
        raise InputDataError(
            f"{thing if capture is None else capture}: contains no cameras of photos.",
            "a model whose fit refined the cameras (cameras.json), or the capture with the photos' cameras.",
            f"cgwm export {typed_path(thing)} --to colmap --capture CAPTURE --out {typed_path(out)}",
        )
    photos = None if capture is None else capture / "images"
    counts = write_colmap(out, cameras, in_world(model), photos, overwrite)
    notes = [] if cameras.scale.kind == "metric" else ["the cameras have no metric scale"]
    if capture is None:
        notes.append("the photos were not copied, because --capture is missing")
    return {**counts}, notes


def object_model(model: Model, name: str) -> ObjectModel:
    """Return the surface of a body's collision spheres in the colour of the nearest visual sphere, grey without one."""
    from ..geometry.isosurface import union_mesh

    body, spheres = model.body(name), model.collision[name]
    means = np.asarray(spheres.means, np.float64)
    radii = np.asarray(spheres.scales, np.float64) * body.radius_factor
    vertices, faces = union_mesh(means, radii)
    colors = np.full((len(vertices), 3), 128, np.uint8)
    visual = model.body_splats.get(name)
    if visual is not None:
        nearest = KDTree(visual.means).query(vertices)[1]
        colors = np.round(np.clip(np.asarray(visual.colors)[nearest], 0, 1) * 255).astype(np.uint8)
    off = body.collision_distance_m
    far = "" if off is None else f", at most {1e3 * off:.2g} mm from the fitted surface"
    return ObjectModel(vertices, faces, colors, f"surface of {len(means)} collision spheres{far}")


def _simulated(thing: Path) -> Model:
    model = read_model(thing)
    lacking = [body.name for body in model.file.bodies if body.name not in model.collision]
    if lacking or model.file.contact is None:
        what = f"the body '{lacking[0]}' has no collision spheres" if lacking else "its physics are not fitted"
        todo = "fit it to a capture with motion (tracks or videos): cgwm fit CAPTURE --out MODEL."
        raise InputDataError(f"{thing}: {what}.", todo=todo)
    return model


def _visible(thing: Path) -> Model:
    model = read_model(thing)
    if model.visual_count == 0:
        raise InputDataError(
            f"{thing}: the model has no visual spheres.", todo="fit it to photos: cgwm fit CAPTURE --out MODEL."
        )
    return model


def _light_notes(model: Model) -> list[str]:
    return [] if model.file.light is None else [NO_TURNING]


_WORK: dict[ExportFormat, Callable[[Path, Path, ExportOptions, bool], tuple[Facts, list[str]]]] = {
    "lerobot": _lerobot,
    "bop": _bop,
    "nerfstudio": _nerfstudio,
    "rerun": _rerun,
    "mjcf": _mjcf,
    "urdf": _urdf,
    "sdf": _sdf,
    "usd": _usd,
    "ply": _ply,
    "colmap": _colmap,
    "glb": _glb,
    "mesh": _mesh,
}
