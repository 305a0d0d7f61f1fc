"""Film a planned scene: write its photos, videos, masks, tracks, manifest and truth into a directory."""

from __future__ import annotations

import threading
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ...schemas import (
    CAPTURE_FORMAT,
    Body,
    Calibration,
    CameraIntrinsics,
    CamerasFile,
    CaptureManifest,
    Ground,
    Marker,
    Measurement,
    Pose,
    PosedImage,
    PosedVideo,
    Scale,
    Shape,
    SphereShape,
    Video,
    World,
)
from ..capture.cameras import Camera
from ..capture.images import write_image
from ..capture.manifest import write_manifest
from ..capture.tracks import write_tracks
from ..io.processors import processors
from ..io.progress import progress
from .dynamics import (
    BODY_GROUP,
    FINGERTIP,
    FINGERTIP_RADIUS,
    GRAVITY,
    OBJECT,
    STEPS_PER_S,
    Motion,
    build_model,
    matrix_from_quat,
    quat_from_matrix,
)
from .objects import write_obj
from .plan import EpisodePlan, ScenePlan
from .raycast import Lamp, Material, Plain, Printed, Raycaster, Window, window_around
from .rig import (
    MARKER_DICTIONARY,
    MAT_HALF,
    PrintedMarker,
    draw_lamp,
    draw_markers,
    make_mat,
    make_paint,
    photo_cameras,
    video_cameras,
)
from .sensor import draw_gain, expose
from .tracker import POSITION_STD, ROTATION_STD, measure_tracks, track_times
from .truth import TRUTH_FILE, TRUTH_MESH, TrueContact, TrueMotion, TrueObject, TruthFile

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
ItemT = TypeVar("ItemT")
Vector3 = tuple[float, float, float]

EXPOSURE_STEPS = (-8, 0, 8)
"""Moments, in steps of the simulation, whose mean is one video frame: an exposure of 1/150 s about its time."""
_AWAY = -100.0  # height at which a body is out of sight, below the mat
_THREADS = 8
"""Maximum number of threads that draw; each needs a hundred megabytes."""
_JPEG_QUALITY_PHOTO, _JPEG_QUALITY_VIDEO = 95, 92


@dataclass(frozen=True, kw_only=True)
class Set:
    """Everything that is in front of and behind the cameras while a scene is filmed."""

    plan: ScenePlan
    caster: Raycaster
    lamp: Lamp
    markers: tuple[PrintedMarker, ...]
    photos: dict[str, Camera]
    videos: dict[str, Camera]
    gains: dict[str, Vector3]
    samples: int = 3
    """Rays along and across a video's pixel on which surfaces meet, at each moment of an exposure."""
    still: float = 0.0
    """Bodies that have moved by no more than this, in metres and entries of quaternions, are not drawn anew."""
    tests_every: int = 1
    """Of test videos the first two frames are drawn, and then one in so many, which are those
    that `VideoErrors` with that number looks at; those between repeat them."""


def build_set(
    plan: ScenePlan,
    photo_size: tuple[int, int],
    video_size: tuple[int, int],
    photos: int,
    paint: Material | None = None,
    smooth: bool = False,
    samples: int = 3,
    still: float = 0.0,
    tests_every: int = 1,
) -> Set:
    """Build what is filmed; the sizes [px] and the number of photos change nothing else about it.

    Args:
        plan: The scene.
        photo_size: Width and height of the photos [px].
        video_size: Width and height of the video frames [px].
        photos: Number of photos.
        paint: The object's material; by default it is painted by the plan's seed.
        smooth: Whether the object's many facets are to look like one smooth surface at their seams.
        samples: See `Set`.
        still: See `Set`.
        tests_every: See `Set`.
    """
    rng = np.random.default_rng([plan.seed, 4])
    markers, lamp = draw_markers(rng), draw_lamp(rng)
    model = build_model(plan.solid, plan.contact, plan.fingertip, MAT_HALF)
    printed = Printed(make_mat(np.random.default_rng([plan.seed, 5]), markers))
    painted = paint or make_paint(np.random.default_rng([plan.seed, 6]), plan.solid)
    parts = [geom for geom in range(model.ngeom) if model.geom(geom).name.startswith("part")]
    materials = {model.geom("ground").id: printed, **dict.fromkeys(parts, painted)}
    labels = dict.fromkeys(parts, 1)
    if plan.fingertip:
        tip = model.geom(FINGERTIP).id
        materials[tip], labels[tip] = Plain((0.16, 0.55, 0.28)), 2
    assert all(model.geom_group[geom] == BODY_GROUP for geom in labels)
    caster = Raycaster(model, materials, labels, lamp=lamp, backdrop=(0.62, 0.64, 0.66), smooth=parts if smooth else ())
    gains = {"photos": draw_gain(rng, 1.0), "left": draw_gain(rng, rng.uniform(0.84, 0.94))}
    gains["right"] = draw_gain(rng, rng.uniform(1.06, 1.16))
    cameras = photo_cameras(photos, photo_size, np.random.default_rng([plan.seed, 7]))
    films = video_cameras(plan.seed, video_size)
    return Set(
        plan=plan,
        caster=caster,
        lamp=lamp,
        markers=markers,
        photos=cameras,
        videos=films,
        gains=gains,
        samples=samples,
        still=still,
        tests_every=tests_every,
    )


def record(scene: Set, out: Path) -> None:
    """Write the whole capture into the empty directory `out`."""
    plan = scene.plan
    take_photos(scene, out)
    stills = {name: _empty(scene, camera) for name, camera in scene.videos.items()}
    films = [(camera, episode) for camera in scene.videos for episode in plan.episodes]
    films = sorted(films, key=lambda one: -one[1].frame_count)  # so that all threads end at about the same time

    def work(own: Set, one: tuple[str, EpisodePlan]) -> int:
        film(own, *one, stills[one[0]], out)
        return one[1].frame_count

    _draw_all(scene, work, films, "filming", sum(episode.frame_count for _, episode in films), "frame")
    (out / "tracks").mkdir()
    for episode in plan.episodes:
        write_tracks(out / "tracks" / f"{episode.name}.csv", measure_tracks(plan, episode))
    write_manifest(out / "capture.toml", manifest(scene))
    write_obj(out / TRUTH_MESH, plan.solid)
    (out / TRUTH_FILE).write_text(truth(scene).model_dump_json() + "\n", encoding="utf-8")


def take_photos(scene: Set, out: Path) -> None:
    """Write images/ and masks/: the object at rest, no fingertip."""
    plan = scene.plan
    (out / "images").mkdir()
    (out / "masks").mkdir()

    def work(own: Set, one: tuple[int, tuple[str, Camera]]) -> int:
        index, (name, camera) = one
        own.caster.place(_qpos(plan, plan.photo_qpos))
        rng = np.random.default_rng([plan.seed, 9, index])
        view = own.caster.render(camera)
        image = expose(view.color, own.gains["photos"], rng)
        write_image(out / "images" / name, image, _JPEG_QUALITY_PHOTO)
        write_image((out / "masks" / name).with_suffix(".png"), view.label)
        return 1

    _draw_all(scene, work, list(enumerate(scene.photos.items())), "taking photos", len(scene.photos), "photo")


def _draw_all(
    scene: Set, work: Callable[[Set, ItemT], int], items: Sequence[ItemT], name: str, total: int, unit: str
) -> None:
    """Draw what does not depend on each other in a thread of each processor, each with bodies of its own to place.

    Args:
        scene: What is drawn.
        work: Draws an item of the scene, and returns how many of `total` that were.
        items: What is drawn, in the order in which it begins.
        name: Name of the progress bar.
        total: Its end.
        unit: What it counts.
    """
    local = threading.local()

    def begun(item: ItemT) -> int:
        if not hasattr(local, "scene"):
            local.scene = replace(scene, caster=scene.caster.apart())
        return work(local.scene, item)

    with progress(desc=name, total=total, unit=unit) as bar, ThreadPoolExecutor(min(processors(), _THREADS)) as pool:
        for done in pool.map(begun, items):
            bar.update(done)


def film(scene: Set, camera_name: str, episode: EpisodePlan, still: Floats, out: Path) -> None:
    """Write one camera's video of one episode, with masks.

    Args:
        scene: What is filmed.
        camera_name: The camera.
        episode: The episode.
        still: What the camera sees with the bodies away, ideal colours, shape (height, width, 3).
        out: Directory of the capture.
    """
    camera, plan = scene.videos[camera_name], scene.plan
    images, masks = (out / kind / camera_name / episode.name for kind in ("videos", "video_masks"))
    images.mkdir(parents=True)
    masks.mkdir(parents=True)
    key = zlib.crc32(f"{camera_name}/{episode.name}".encode())
    every, drawn = scene.tests_every if episode.split == "test" else 1, None
    colours, label = still, np.zeros(still.shape[:2], np.uint8)
    for frame in range(episode.frame_count):
        poses = _moments(episode.motion, frame / plan.frame_rate)
        if drawn is None or ((frame - 1) % every == 0 and np.abs(poses - drawn).max() > scene.still):
            colours, label = frame_of(scene, camera, episode.motion, frame / plan.frame_rate, still)
            drawn = poses
        rng = np.random.default_rng([plan.seed, 10, key, frame])
        image = expose(colours, scene.gains[camera_name], rng)
        write_image(images / f"{frame:06d}.jpg", image, _JPEG_QUALITY_VIDEO)
        write_image(masks / f"{frame:06d}.png", label)


def frame_of(
    scene: Set, camera: Camera, motion: Motion, time: float, still: Floats
) -> tuple[Floats, NDArray[np.uint8]]:
    """Render one video frame: the mean over its exposure, and the labels at its middle.

    Only the part of the image that the bodies or their shadows touch is drawn anew.

    Returns:
        Ideal colours (height, width, 3) and labels, uint8 (height, width).
    """
    caster, moments = scene.caster, _moments(motion, time)
    if np.ptp(moments, axis=0).max() <= scene.still:
        moments = moments[[EXPOSURE_STEPS.index(0)]]
    label, colours = np.zeros(still.shape[:2], np.uint8), still.copy()
    window = _touched(scene, camera, moments)
    if window is None:
        return colours, label
    part = np.s_[window[0] : window[2], window[1] : window[3]]
    total = np.zeros_like(colours[part])
    for index, qpos in enumerate(moments):
        caster.place(qpos)
        view = caster.render(camera, window, scene.samples)
        total += view.color
        if index == len(moments) // 2:
            label[part] = view.label
    colours[part] = total / len(moments)
    return colours, label


def _moments(motion: Motion, time: float) -> Array:
    """Return MuJoCo's positions at the moments of an exposure, shape (moment, nq)."""
    return motion.qpos[motion.row(time) + np.array(EXPOSURE_STEPS)]


def _empty(scene: Set, camera: Camera) -> Floats:
    scene.caster.place(_qpos(scene.plan, np.array([0, 0, _AWAY, 1.0, 0, 0, 0])))
    return scene.caster.render(camera).color


def _touched(scene: Set, camera: Camera, moments: Array) -> Window | None:
    """Return the window that holds the bodies and their shadows on the ground at all moments."""
    points = []
    for qpos in moments:
        points.append(scene.plan.solid.vertices @ matrix_from_quat(qpos[3:7]).T + qpos[:3])
        if scene.plan.fingertip:
            corners = np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(-1, 3)
            points.append(qpos[7:] + FINGERTIP_RADIUS * corners)
    solid = np.concatenate(points)
    lamp = scene.lamp.position
    shadow = lamp + (solid - lamp) * (lamp[2] / (lamp[2] - solid[:, 2:]))
    return window_around(camera, np.concatenate([solid, shadow]))


def _qpos(plan: ScenePlan, body_qpos: Array) -> Array:
    """Return MuJoCo positions with the object at `body_qpos`, shape (7,), and the fingertip out of sight."""
    return np.concatenate([body_qpos, [0, 0, _AWAY]]) if plan.fingertip else body_qpos


def manifest(scene: Set) -> CaptureManifest:
    """Return the manifest: what a user with a scale, a tracker and a printed sheet of markers would know."""
    plan = scene.plan
    bodies = [Body(name=OBJECT, mass_kg=plan.solid.mass, photo_pose=_pose(plan.photo_qpos))]
    if plan.fingertip:
        shape = Shape(sphere=SphereShape(radius_m=FINGERTIP_RADIUS))
        # It is not in the photos; a pose far away says so.
        away = Pose(position_m=(0.0, 0.0, 10.0))
        bodies.append(Body(name=FINGERTIP, motion="driven", shape=shape, photo_pose=away))
    splits: dict[str, tuple[str, ...]] = {}
    for episode in plan.episodes:
        splits[episode.split] = (*splits.get(episode.split, ()), episode.name)
    markers = []
    for marker in scene.markers:
        T = marker.T_world_marker
        pose = _pose(np.concatenate([T[:3, 3], quat_from_matrix(T[:3, :3])]))
        markers.append(Marker(id=marker.id, side_m=marker.side, pose=pose))
    return CaptureManifest(
        format=CAPTURE_FORMAT,
        world=World(gravity_m_s2=(0.0, 0.0, -GRAVITY), ground=Ground()),
        bodies=tuple(bodies),
        measurement=Measurement(position_std_m=POSITION_STD, rotation_std_rad=round(float(ROTATION_STD), 6)),
        splits=splits,
        video=Video(frame_rate_hz=plan.frame_rate),
        calibration=Calibration(aruco_dictionary=MARKER_DICTIONARY, markers=tuple(markers)),
    )


def _pose(qpos: Array) -> Pose:
    x, y, z, qw, qx, qy, qz = (round(float(value), 9) for value in qpos)
    return Pose(position_m=(x, y, z), quat_wxyz=(qw, qx, qy, qz))


def truth(scene: Set) -> TruthFile:
    """Return everything that is truly so; see truth.py."""
    plan, contact, solid = scene.plan, scene.plan.contact, scene.plan.solid
    moments = solid.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return TruthFile(
        scene=plan.name,
        seed=plan.seed,
        object=TrueObject(
            family=solid.family, mass_kg=solid.mass, com_m=_floats(solid.com), inertia_kg_m2=_floats(moments)
        ),
        contact=TrueContact(
            friction=contact.friction,
            friction_fingertip=contact.friction_fingertip if plan.fingertip else None,
            natural_time_s=contact.natural_time,
            damping_ratio=contact.damping_ratio,
            impedance=contact.impedance,
            timestep_s=1 / STEPS_PER_S,
        ),
        cameras=_cameras_file(scene),
        gain_rgb=scene.gains,
        episodes={episode.name: _true_motion(plan, episode) for episode in plan.episodes},
    )


def _true_motion(plan: ScenePlan, episode: EpisodePlan) -> TrueMotion:
    times = track_times(plan, episode)
    rows = episode.motion.rows(times)
    qpos, qvel = episode.motion.qpos[rows], episode.motion.qvel[rows]
    return TrueMotion(
        first_contact_s=episode.motion.first_contact,
        time_s=_floats(times),
        position_m=_floats(qpos[:, :3]),
        quat_wxyz=_floats(qpos[:, 3:7]),
        velocity_m_s=_floats(qvel[:, :3]),
        omega_body_rad_s=_floats(qvel[:, 3:6]),
    )


def _cameras_file(scene: Set) -> CamerasFile:
    intrinsics = {"photos": next(iter(scene.photos.values())), **scene.videos}
    return CamerasFile(
        scale=Scale(kind="metric", source="truth", relative_std=0.0),
        cameras={name: _intrinsics(camera) for name, camera in intrinsics.items()},
        images={
            name: PosedImage(camera="photos", T_world_cam=_floats(camera.T_world_cam))
            for name, camera in scene.photos.items()
        },
        videos={
            name: PosedVideo(camera=name, T_world_cam=_floats(camera.T_world_cam))
            for name, camera in scene.videos.items()
        },
    )


def _intrinsics(camera: Camera) -> CameraIntrinsics:
    fx, fy, cx, cy = (float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return CameraIntrinsics(width=camera.width, height=camera.height, fx=fx, fy=fy, cx=cx, cy=cy)


def _floats(values: Array) -> tuple:
    """Return an array as nested tuples, as the schemas take it."""
    return tuple(_floats(row) if row.ndim else float(row) for row in np.asarray(values))
