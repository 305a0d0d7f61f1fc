"""The manifest of a capture, `capture.toml`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from .articulations import Articulation
from .base import FileModel
from .cameras import CameraIntrinsics
from .materials import pair_of, repeated
from .pose import Pose
from .quantities import (
    ContactTime,
    Coordinate,
    DampingRatio,
    Deviation,
    FaceExponent,
    FacePoints,
    FrameRate,
    Friction,
    Gravity,
    Instant,
    Length,
    Mass,
    Position3,
    Vector3,
    unit_vector,
)
from .surfaces import Surface

CAPTURE_FORMAT = "cgwm-capture/1"

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=120)]
Pixel = Annotated[float, Field(ge=-1e6, le=1e6)]
TRIANGLE_SLACK = 0.02
"""Share of the sum of all moments of inertia by which one may exceed the other two: rounding. Of a thin plate, one is
the sum of the other two."""


def physical_inertia(value: tuple[float, ...]) -> tuple[float, ...]:
    """Refuse what is no inertia of a body [kg m2]: 3 or 6 numbers, positive, obeying the triangle inequality."""
    if len(value) not in (3, 6):
        raise ValueError(f"takes 3 numbers (xx, yy, zz) or 6 (xx, yy, zz, xy, xz, yz); found {len(value)}")
    size = max(map(abs, value))
    xx, yy, zz, xy, xz, yz = (entry / (size or 1.0) for entry in (*value, 0.0, 0.0, 0.0)[:6])
    if not _positive_definite(xx, yy, zz, (xy, xz, yz)):
        raise ValueError("the inertia must be positive definite")
    half = (1 + TRIANGLE_SLACK) / 2 * (xx + yy + zz)
    if not _positive_definite(half - xx, half - yy, half - zz, (-xy, -xz, -yz)):
        raise ValueError("no body has this inertia: one moment is larger than the other two together")
    return value


def _positive_definite(xx: float, yy: float, zz: float, products: Vector3) -> bool:
    """Return whether a symmetric matrix is positive definite; products: xy, xz, yz."""
    xy, xz, yz = products
    minor = xx * yy - xy * xy
    determinant = zz * minor + 2 * xy * xz * yz - xx * yz * yz - yy * xz * xz
    return min(xx, yy, zz, minor, determinant) > 0


class Ground(FileModel):
    """A half space that nothing penetrates: points with normal . x < offset are inside it."""

    normal: Vector3 = (0.0, 0.0, 1.0)
    """Unit normal, world frame, pointing out of the ground."""
    offset_m: Coordinate = 0.0
    """Height of the plane along the normal [m]."""
    material: Name | None = None
    """Its material, where it matters what touches it."""

    @field_validator("normal")
    @classmethod
    def _unit(cls, value: Vector3) -> Vector3:
        return unit_vector(value, "the ground normal")


class World(FileModel):
    """What surrounds the bodies."""

    gravity_m_s2: Gravity = (0.0, 0.0, -9.81)
    """Gravitational acceleration [m/s2], world frame."""
    ground: Ground | None = None
    """The ground, or nothing where there is none."""


class BoxShape(FileModel):
    """A box, centred at the body frame's origin and aligned with its axes."""

    half_extents_m: tuple[Length, Length, Length]


class SphereShape(FileModel):
    """A ball, centred at the body frame's origin."""

    radius_m: Length


class FileShape(FileModel):
    """A shape in a file beside the manifest, in the body frame, in metres."""

    path: str


class Shape(FileModel):
    """The shape of a body: exactly one of the four."""

    box: BoxShape | None = None
    sphere: SphereShape | None = None
    mesh: FileShape | None = None
    """A closed triangle mesh (.obj or .stl), metres."""
    splats: FileShape | None = None
    """Spherical Gaussians (.ply)."""

    @model_validator(mode="after")
    def _one(self) -> Shape:
        given = [name for name in ("box", "sphere", "mesh", "splats") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a shape is exactly one of box, sphere, mesh, splats; found {given or 'none'}")
        return self


class PhotoBox(FileModel):
    """A box along the world's axes that holds a body, and nothing else than some ground, in the photos.

    In the unit of the cameras: metres, unless they are unscaled.
    """

    min_m: Position3
    max_m: Position3

    @model_validator(mode="after")
    def _ordered(self) -> PhotoBox:
        for axis, low, high in zip("xyz", self.min_m, self.max_m, strict=True):
            if not low < high:
                raise ValueError(f"min_m must be below max_m in {axis}; found {low:g} and {high:g}")
        return self


class Body(FileModel):
    """A rigid body."""

    name: Name
    motion: Literal["free", "driven", "fixed", "link"] = "free"
    """free: moves by physics; driven: its track is the command; fixed: does not move; link: of [[articulations]], not
    to be written by hand."""
    mass_kg: Mass | None = None
    """Mass [kg]; left out: free, and fitted only where a force makes it observable."""
    inertia_kg_m2: tuple[float, ...] | None = None
    """Inertia about the centre of mass, body axes: diagonal, or xx yy zz xy xz yz; left out: from the shape."""
    com_m: Position3 | None = None
    """Centre of mass in the body frame [m]; left out: from the shape."""
    shape: Shape | None = None
    """Left out: from the photos (stage SG-GS)."""
    photo_pose: Pose | None = None
    """T_world_body while the photos were taken; default identity (see `Capture`)."""
    material: Name | None = None
    """Its material, one of [[materials]], where it matters what touches it."""
    face_points: FacePoints = 0
    """Least number of points on each flat face of a convex body, by which the ground carries it as a plate; 0: by its
    corners alone, as it suffices where it tumbles."""
    face_exponent: FaceExponent = 0.0
    """Power of the distance from the middle of its face by which a point carries more [1]: 0 for an even elastic layer,
    about 2 for a stiff plate, which rests on its corners."""
    photo_box: PhotoBox | None = None
    """Where the body is in photos without masks; left out: found on the ground (stage SG-GS)."""

    @field_validator("inertia_kg_m2")
    @classmethod
    def _physical(cls, value: tuple[float, ...] | None) -> tuple[float, ...] | None:
        return None if value is None else physical_inertia(value)


class Material(FileModel):
    """A material of bodies and of the ground."""

    name: Name
    friction: Friction | None = None
    """Coulomb coefficient of a contact with itself [1]. A pair that [[pairs]] does not give has the geometric mean of
    its two materials' numbers, where both have one."""


class MaterialPair(FileModel):
    """What is known before the fit about contacts between two materials, in either order."""

    materials: tuple[Name, Name]
    """Two names of [[materials]], or one twice."""
    friction: Friction | None = None
    """Coulomb coefficient [1]."""
    contact_time_s: ContactTime | None = None
    """Natural contact time [s]."""
    damping_ratio: DampingRatio | None = None
    """Damping ratio of a contact [1]."""


class Measurement(FileModel):
    """How well the tracks are measured; estimated from the data where left out."""

    position_std_m: Deviation | None = None
    rotation_std_rad: Deviation | None = None
    force_std_n: Deviation | None = None
    """Of a component of a measured force [N]."""


class Episode(FileModel):
    """Facts about one episode."""

    group: str | None = None
    """The session that the episode belongs to."""
    start_s: Instant | None = None
    """Ignore what was measured before this time [s]."""
    end_s: Instant | None = None
    """Ignore what was measured after this time [s]."""

    @model_validator(mode="after")
    def _ordered(self) -> Episode:
        if self.start_s is not None and self.end_s is not None and self.end_s <= self.start_s:
            raise ValueError(f"end_s ({self.end_s:g}) must be later than start_s ({self.start_s:g})")
        return self


class Video(FileModel):
    """Timing of the videos; frame k of a camera shows the world at k / frame_rate_hz + its offset."""

    frame_rate_hz: FrameRate = 30.0
    camera_time_offset_s: dict[str, Instant] = {}
    """Added to the frame times of a camera [s]."""


_LEAST_LENGTH_M, _MOST_MARKER_M, _MOST_DISTANCE_M = 0.002, 3.0, 50.0
"""Lengths of the sources of scale that are not taken for those in another unit [m]."""


def _in_metres(what: str, most_m: float) -> AfterValidator:
    """Return a check that a scene on a table or in a room may have a length; others are in another unit."""

    def checked(length_m: float) -> float:
        if not _LEAST_LENGTH_M <= length_m <= most_m:
            hint = f"; {length_m / 1000.0:g} if these are millimetres" if length_m > most_m else ""
            limits = f"{_LEAST_LENGTH_M:g} to {most_m:g}"
            raise ValueError(f"{what} of {length_m:g} m; lengths are in metres, {limits}{hint}")
        return length_m

    return AfterValidator(checked)


_Side = Annotated[Length, _in_metres("a marker", _MOST_MARKER_M)]
_Distance = Annotated[Length, _in_metres("a distance", _MOST_DISTANCE_M)]


class Marker(FileModel):
    """An ArUco marker of known size that is visible in the photos."""

    id: Annotated[int, Field(ge=0, le=100_000)]
    side_m: _Side
    """Length of the black square's side [m]."""
    pose: Pose | None = None
    """T_world_marker (x right, y up as printed, z out of the paper); fixes the world frame where given."""


class KnownDistance(FileModel):
    """A known distance between two points that are marked in at least two photos each."""

    distance_m: _Distance
    a_px: dict[str, tuple[Pixel, Pixel]]
    """Photo (path relative to images/) to pixel (x, y) of the first point; top-left pixel centre is (0.5, 0.5)."""
    b_px: dict[str, tuple[Pixel, Pixel]]
    """The same for the second point."""

    @model_validator(mode="after")
    def _two_views(self) -> KnownDistance:
        for name, marks in (("a_px", self.a_px), ("b_px", self.b_px)):
            if len(marks) < 2:
                raise ValueError(f"{name} marks the point in {len(marks)} photo(s); at least 2 are needed")
        return self


class KnownCameraDistance(FileModel):
    """A known distance between the optical centres of two photos."""

    distance_m: _Distance
    images: tuple[str, str]
    """The two photos (paths relative to images/)."""


class Calibration(FileModel):
    """What `cgwm calibrate` knows about scale and world frame. Give at most one source of scale."""

    aruco_dictionary: str = "4X4_50"
    """OpenCV's name without the prefix DICT_."""
    markers: tuple[Marker, ...] = ()
    known_distance: KnownDistance | None = None
    known_camera_distance: KnownCameraDistance | None = None
    supplied_in_metres: bool = False
    """Whether a supplied transforms.json or COLMAP model is in metres; cameras.json says it itself."""
    same_camera: bool = True
    """Whether all photos (not the video frames) were taken with one camera at one focal length."""
    intrinsics: tuple[CameraIntrinsics, ...] = ()
    """Known intrinsics of the photos of a size, as in cameras.json; they are used as they are. Those of other sizes are
    estimated."""

    @model_validator(mode="after")
    def _known_cameras(self) -> Calibration:
        sizes = [(one.width, one.height) for one in self.intrinsics]
        twice = next((size for size in sizes if sizes.count(size) > 1), None)
        if twice is not None:
            raise ValueError(f"two [[calibration.intrinsics]] are of photos of {twice[0]}x{twice[1]}; give one a size")
        if any(len(one.distortion) > 4 for one in self.intrinsics):
            raise ValueError("[[calibration.intrinsics]] take the distortion k1, k2, p1, p2; k3 is not used")
        return self

    @model_validator(mode="after")
    def _one_scale(self) -> Calibration:
        sources = [
            bool(self.markers),
            self.known_distance is not None,
            self.known_camera_distance is not None,
        ]
        if sum(sources) > 1:
            raise ValueError("give one source of scale: markers, known_distance or known_camera_distance")
        ids = [marker.id for marker in self.markers]
        if len(set(ids)) != len(ids):
            raise ValueError(f"marker ids must differ; found {ids}")
        return self


def _require_known_materials(manifest: CaptureManifest) -> None:
    """Refuse materials and pairs that are named twice, or that [[materials]] does not have."""
    known = [material.name for material in manifest.materials]
    twice = repeated(known)
    if twice is not None:
        raise ValueError(f"two [[materials]] have the name '{twice}'; names must differ")
    for where, name in _named_materials(manifest):
        if name is not None and name not in known:
            listed = f"they are {', '.join(known)}" if known else "there are none"
            raise ValueError(f"{where} names the material '{name}', which is not among [[materials]]; {listed}")
    again = repeated(" and ".join(f"'{name}'" for name in pair_of(*pair.materials)) for pair in manifest.pairs)
    if again is not None:
        raise ValueError(f"two [[pairs]] are of {again}; each pair of materials stands once, in either order")


def _named_materials(manifest: CaptureManifest) -> list[tuple[str, str | None]]:
    """Return what has a material, in the words of messages, and its material."""
    ground = manifest.world.ground
    named = [(f"body '{body.name}'", body.material) for body in manifest.bodies]
    named += [(f"surface '{surface.name}'", surface.material) for surface in manifest.surfaces]
    named += [(f"articulation '{one.name}'", one.material) for one in manifest.articulations]
    named += [("[world].ground", None if ground is None else ground.material)]
    return named + [("[[pairs]]", name) for pair in manifest.pairs for name in pair.materials]


class CaptureManifest(FileModel):
    """`capture.toml`."""

    format: Literal["cgwm-capture/1"]
    world: World = World()
    bodies: tuple[Body, ...] = ()
    articulations: tuple[Articulation, ...] = ()
    """Jointed bodies."""
    materials: tuple[Material, ...] = ()
    """Materials that bodies and ground may have."""
    pairs: tuple[MaterialPair, ...] = ()
    """Contact parameters of pairs of materials, as far as they are known."""
    surfaces: tuple[Surface, ...] = ()
    """Fixed surfaces besides the ground."""
    measurement: Measurement = Measurement()
    splits: dict[Name, tuple[str, ...]] = {}
    episodes: dict[str, Episode] = {}
    video: Video = Video()
    calibration: Calibration = Calibration()

    @model_validator(mode="after")
    def _consistent(self) -> CaptureManifest:
        names = [body.name for body in self.bodies]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"two bodies have the name '{twice[0]}'; names must differ")
        linked = next((body.name for body in self.bodies if body.motion == "link"), None)
        if linked is not None:
            raise ValueError(f"body '{linked}': links are not listed, but come from the file of [[articulations]]")
        again = repeated([one.name for one in self.articulations])
        if again is not None:
            raise ValueError(f"two [[articulations]] have the name '{again}'; names must differ")
        _require_known_materials(self)
        again = repeated([*names, *(surface.name for surface in self.surfaces)])
        if again is not None:
            raise ValueError(f"two surfaces, or a body and a surface, have the name '{again}'; names must differ")
        self._require_distinct_episodes()
        return self

    def _require_distinct_episodes(self) -> None:
        """Refuse a split with an episode twice, and one that is in both "train" and "test"."""
        for split, episodes in self.splits.items():
            if len(set(episodes)) != len(episodes):
                raise ValueError(f"split '{split}' names an episode twice")
        train, test = set(self.splits.get("train", ())), set(self.splits.get("test", ()))
        if train & test:
            raise ValueError(f"episode '{min(train & test)}' is in both train and test")
