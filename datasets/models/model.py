"""Reading and writing of model directories: `model.json`, the spheres of each body, and `fit.json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from ...schemas import BodyModel, CamerasFile, FitFile, InputDataError, ModelFile, read_json
from ...schemas.regular_files import real_path
from ..capture.cameras import require_rigid
from ..capture.tracks import Track, read_tracks, write_tracks
from ..io.atomic import new_directory
from ..io.kinds import refuse_other_kind
from ..shapes.meshes import Mesh
from ..shapes.ply import Splats, read_splats, write_splats
from ..shapes.surfaces import obj_text, stored, surface_meshes
from .agreement import require_agreement
from .effect_files import pack_effects, unpack_effects

CAMERAS = "cameras.json"
POSE_TRACKS = "pose_tracks"
PICTURES = ("held_out.png", "separation.png", "turntable.mp4")
"""Optional pictures of a model: held-out photos with their renders and errors; the separation of bodies from the scene
without masks; and a turntable video of the fitted bodies."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Model:
    """A fitted world model in memory."""

    root: Path | None
    """Directory of the model, or None if it was not read from one."""
    file: ModelFile
    """`model.json`."""
    body_splats: dict[str, Splats] = field(default_factory=dict)
    """Visual spheres by body, body frame; a body without photos has none."""
    collision: dict[str, Splats] = field(default_factory=dict)
    """Collision spheres by body, body frame, of which only centres and scales are used; the visual spheres if the model
    has no others.
    """
    surface_meshes: Mapping[str, Mesh] = field(default_factory=dict)
    """Triangles of the fixed surfaces that are meshes, in the frame of the surface, by name."""
    scene: Splats | None = None
    """Background spheres, world frame, or None."""
    fit: FitFile = field(default_factory=FitFile)
    """`fit.json`."""
    cameras: CamerasFile | None = None
    """Cameras of the photos if the fit refined them (`cameras.json`), or None."""
    pictures: dict[str, bytes] = field(default_factory=dict)
    """Contents of the existing files among `PICTURES`, by name."""
    tracks: dict[str, dict[str, Track]] = field(default_factory=dict)
    """Poses that the fit found in videos, by episode and body (`pose_tracks/<episode>.csv`)."""

    def body(self, name: str) -> BodyModel:
        """Return the entry of a body in `model.json`."""
        return next(body for body in self.file.bodies if body.name == name)

    @property
    def place(self) -> str:
        """Return what the model is called in messages: its `model.json`, where it was read from one."""
        return "the model" if self.root is None else str(self.root / "model.json")

    @property
    def accepts_units(self) -> bool:
        """Whether the model was fitted with `--accept-units`: its captures' units are right whatever their motion."""
        return bool(self.file.provenance.config.get("accept_units", False))

    @property
    def visual_count(self) -> int:
        """Return the number of spheres that are rendered."""
        return sum(map(len, self.body_splats.values())) + (0 if self.scene is None else len(self.scene))


def read_model(path: Path | str) -> Model:
    """Read a model directory.

    Raises:
        InputDataError: If it is not a model (a capture, a dataset, ...), a file is missing or wrong, or its parts
            contradict each other.
    """
    root = Path(path)
    refuse_other_kind(root, "model")
    file = read_json(root / "model.json", ModelFile)
    file = file.model_copy(update={"effects": unpack_effects(file.effects, root)})
    body_splats, collision = _spheres(root, file)
    require_agreement(file, collision, root / "model.json")
    for surface in file.surfaces:
        if surface.mesh is not None:
            _inside(root, surface.mesh.path)
    scene = None if file.scene is None else read_splats(_inside(root, file.scene), harmonics=True)
    return Model(
        root=root,
        file=file,
        body_splats=body_splats,
        collision=collision,
        surface_meshes=surface_meshes(file.surfaces, root),
        scene=scene,
        fit=read_json(root / "fit.json", FitFile) if (root / "fit.json").is_file() else FitFile(),
        cameras=_cameras(root / CAMERAS),
        pictures={name: (root / name).read_bytes() for name in PICTURES if (root / name).is_file()},
        tracks=_pose_tracks(root, [body.name for body in file.bodies]),
    )


def _pose_tracks(root: Path, names: list[str]) -> dict[str, dict[str, Track]]:
    """Return the poses that a fit of videos has found, by episode and body."""
    return {path.stem: read_tracks(path, names)[0] for path in sorted((root / POSE_TRACKS).glob("*.csv"))}


def _spheres(root: Path, file: ModelFile) -> tuple[dict[str, Splats], dict[str, Splats]]:
    """Return the spheres of each body that are seen, and those that collide."""
    visual: dict[str, Splats] = {}
    collision: dict[str, Splats] = {}
    for body in file.bodies:
        if body.splats is not None:
            visual[body.name] = collision[body.name] = read_splats(_inside(root, body.splats), harmonics=True)
        if body.collision is not None:
            collision[body.name] = read_splats(_inside(root, body.collision))
    return visual, collision


def _cameras(path: Path) -> CamerasFile | None:
    return require_rigid(path, read_json(path, CamerasFile)) if path.is_file() else None


def write_model(path: Path | str, model: Model, overwrite: bool = False) -> Model:
    """Write a model directory atomically, and return the model as written.

    The names of the .ply files in `model.json` are set here: `<body>.ply`, `<body>.collision.ply` if the collision
    spheres are not the visual ones, and `scene.ply`.
    """
    taken = {"scene.ply"}
    files: dict[str, Splats] = {}
    bodies = [_with_files(body, model, taken, files) for body in model.file.bodies]
    scene = None if model.scene is None else "scene.ply"
    meshes = {name: (_free_name(name, ".obj", taken), mesh) for name, mesh in model.surface_meshes.items()}
    surfaces = tuple(
        stored(one, model.surface_meshes.get(one.name), meshes.get(one.name, ("",))[0]) for one in model.file.surfaces
    )
    file = model.file.model_copy(update={"bodies": tuple(bodies), "scene": scene, "surfaces": surfaces})
    with new_directory(path, "model", overwrite) as directory:
        for name, splats in files.items():
            write_splats(directory / name, splats, "body")
        for name, mesh in meshes.values():
            (directory / name).write_text(obj_text(mesh), encoding="utf-8")
        _write_surroundings(directory, model)
        (directory / "fit.json").write_text(model.fit.model_dump_json(indent=1) + "\n", encoding="utf-8")
        packed = file.model_copy(update={"effects": pack_effects(file.effects, directory)})
        (directory / "model.json").write_text(packed.model_dump_json(indent=1) + "\n", encoding="utf-8")
    return replace(model, root=Path(path), file=file)


def _with_files(body: BodyModel, model: Model, taken: set[str], files: dict[str, Splats]) -> BodyModel:
    """Return a body with the names of its files, and add these with their spheres to `files`."""
    seen, collision = model.body_splats.get(body.name), model.collision.get(body.name)
    update: dict[str, str | None] = {"splats": None, "collision": None}
    for key, suffix, splats in (("splats", ".ply", seen), ("collision", ".collision.ply", collision)):
        name = _free_name(body.name, suffix, taken)
        if splats and (key == "splats" or splats is not seen):
            files[name], update[key] = splats, name
    return body.model_copy(update=update)


def _write_surroundings(directory: Path, model: Model) -> None:
    """Write what a model has beside its bodies: the background, cameras, pictures and tracks of poses."""
    if model.scene is not None:
        write_splats(directory / "scene.ply", model.scene, "world")
    if model.cameras is not None:
        (directory / CAMERAS).write_text(model.cameras.model_dump_json(indent=1) + "\n", encoding="utf-8")
    for name, content in model.pictures.items():
        (directory / name).write_bytes(content)
    if model.tracks:
        (directory / POSE_TRACKS).mkdir()
    for episode, tracks in model.tracks.items():
        write_tracks(directory / POSE_TRACKS / f"{episode}.csv", tracks)


def _free_name(body: str, suffix: str, taken: set[str]) -> str:
    name, number = f"{body}{suffix}", 2
    while name in taken:
        name, number = f"{body}-{number}{suffix}", number + 1
    taken.add(name)
    return name


def _inside(root: Path, name: str) -> Path:
    path = root / name
    if not real_path(path).is_relative_to(real_path(root)):
        raise InputDataError(
            f"{root / 'model.json'}: '{name}' lies outside the model.",
            "files of its directory.",
            "copy the file into the model, and name it there.",
        )
    return path
