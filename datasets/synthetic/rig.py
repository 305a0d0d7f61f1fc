"""The surroundings of the object: the textured mat with its markers, the cameras, the lamp and the colours."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..capture.cameras import Camera
from .objects import SolidObject, facet_normals
from .raycast import Faceted, Lamp
from .textures import Colour, Sheet, make_sheet, paint, paste_marker

Array = NDArray[np.float64]

MAT_HALF = 1.0
"""Half the side of the textured mat [m]."""
MARKER_DICTIONARY = "4X4_50"
VIDEO_CAMERAS = ("left", "right")
_MAT_PIXELS = 3200
_FACET_SIDE, _FACET_PIXELS = 0.22, 550

# The first colour is the base, the others are for specks; mats have muted colours, objects saturated ones.
_MATS: tuple[tuple[Colour, ...], ...] = (
    ((0.56, 0.53, 0.48), (0.42, 0.40, 0.37), (0.68, 0.64, 0.57), (0.50, 0.42, 0.36), (0.60, 0.60, 0.58)),
    ((0.60, 0.50, 0.40), (0.47, 0.38, 0.29), (0.70, 0.60, 0.48), (0.54, 0.50, 0.45), (0.63, 0.48, 0.34)),
    ((0.47, 0.51, 0.56), (0.36, 0.40, 0.46), (0.58, 0.62, 0.66), (0.45, 0.46, 0.47), (0.40, 0.48, 0.56)),
    ((0.50, 0.55, 0.47), (0.38, 0.43, 0.36), (0.61, 0.65, 0.56), (0.52, 0.50, 0.43), (0.45, 0.54, 0.48)),
)
_PAINTS: tuple[tuple[Colour, ...], ...] = (
    ((0.72, 0.34, 0.26), (0.82, 0.56, 0.32), (0.52, 0.22, 0.22), (0.80, 0.70, 0.55), (0.60, 0.30, 0.38)),
    ((0.22, 0.48, 0.62), (0.36, 0.62, 0.68), (0.18, 0.34, 0.52), (0.62, 0.70, 0.66), (0.30, 0.42, 0.40)),
    ((0.80, 0.64, 0.24), (0.66, 0.46, 0.20), (0.86, 0.78, 0.50), (0.56, 0.52, 0.30), (0.72, 0.40, 0.26)),
    ((0.46, 0.32, 0.58), (0.64, 0.46, 0.66), (0.34, 0.26, 0.48), (0.70, 0.62, 0.72), (0.42, 0.42, 0.62)),
)


@dataclass(frozen=True)
class PrintedMarker:
    """An ArUco marker on the mat.

    Args:
        id: Its number in the dictionary.
        side: Side of the black square [m].
        T_world_marker: Pose; x right, y up as printed, z out of the paper; shape (4, 4).
    """

    id: int
    side: float
    T_world_marker: Array


def draw_markers(rng: np.random.Generator) -> tuple[PrintedMarker, ...]:
    """Place four markers of 60 to 68 mm around the object, each with a random rotation."""
    markers = []
    for index in range(4):
        angle = np.pi / 4 + index * np.pi / 2 + rng.uniform(-0.15, 0.15)
        yaw, distance = rng.uniform(-np.pi, np.pi), rng.uniform(0.170, 0.182)
        T_world_marker = np.eye(4)
        T_world_marker[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T_world_marker[:2, 3] = np.round(distance * np.array([np.cos(angle), np.sin(angle)]), 4)
        markers.append(PrintedMarker(index, float(np.round(rng.uniform(0.060, 0.068), 3)), T_world_marker))
    return tuple(markers)


def make_mat(rng: np.random.Generator, markers: tuple[PrintedMarker, ...]) -> Sheet:
    """Paint the mat and print the markers on it; u and v are the x and y axes of the world."""
    palette = _MATS[rng.integers(len(_MATS))]
    image = paint(rng, _MAT_PIXELS, 2 * MAT_HALF, palette, 13000, (0.0018, 0.016))
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{MARKER_DICTIONARY}"))
    for marker in markers:
        modules = dictionary.markerSize + 2
        code = np.asarray(cv2.aruco.generateImageMarker(dictionary, marker.id, modules), np.uint8)
        paste_marker(image, 2 * MAT_HALF, code, marker.side, marker.T_world_marker)
    return make_sheet(image, 2 * MAT_HALF)


def make_paint(rng: np.random.Generator, solid: SolidObject) -> Faceted:
    """Paint every side of an object: each gets a base tone from one palette, and specks half-way to its colours."""
    palette = _PAINTS[rng.integers(len(_PAINTS))]
    normals = facet_normals(solid)
    sheets = []
    for _ in normals:
        base = palette[rng.integers(2)]
        tone = tuple(float(v) for v in np.array(base) * rng.uniform(0.88, 1.12))
        red, green, blue = tone
        specks = [((red + r) / 2, (green + g) / 2, (blue + b) / 2) for r, g, b in palette]
        image = paint(rng, _FACET_PIXELS, _FACET_SIDE, ((red, green, blue), *specks), 12000, (0.002, 0.012))
        sheets.append(make_sheet(image, _FACET_SIDE))
    return Faceted(normals, tuple(sheets))


def draw_lamp(rng: np.random.Generator) -> Lamp:
    """Place the lamp 20 m away, 45 to 60 degrees above the horizon."""
    elevation, azimuth = rng.uniform(np.radians(45), np.radians(60)), rng.uniform(-np.pi, np.pi)
    flat = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
    return Lamp(20 * np.array([*flat, np.sin(elevation)]))


def photo_cameras(count: int, size: tuple[int, int], rng: np.random.Generator) -> dict[str, Camera]:
    """Place the cameras of hand-held photos on rings at elevations of about 15, 35 and 65 degrees, every third closer.

    Args:
        count: Number of photos.
        size: Width and height [px]; the horizontal field of view does not depend on it.
        rng: Source of the jitter of hand-held photos.

    Returns:
        Cameras, keyed by the path of the photo relative to images/.
    """
    low, middle = round(count * 0.375), round(count * 0.375)
    rings = ((15.0, low, 0.50), (35.0, middle, 0.48), (65.0, count - low - middle, 0.46))
    cameras: dict[str, Camera] = {}
    for elevation, number, distance in rings:
        for index in range(number):
            azimuth = 2 * np.pi * index / number + rng.uniform(-0.08, 0.08)
            tilt = np.radians(elevation + rng.uniform(-3, 3))
            reach = distance * (0.74 if index % 3 == 1 else 1.0) * rng.uniform(0.96, 1.04)
            direction = np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
            target = np.array([0, 0, 0.03]) + rng.uniform(-0.012, 0.012, 3)
            T_world_cam = look_at(target + reach * direction, target, rng.uniform(-0.07, 0.07))
            cameras[f"{len(cameras):03d}.jpg"] = _camera(size, 1.0, T_world_cam)
    return cameras


def video_cameras(seed: int, size: tuple[int, int] = (480, 360)) -> dict[str, Camera]:
    """Place the two static video cameras, about 80 degrees apart and 0.86 m from the object.

    Args:
        seed: Seed of their exact positions.
        size: Width and height [px]; the horizontal field of view does not depend on it.
    """
    rng = np.random.default_rng([seed, 8])
    facing = rng.uniform(-np.pi, np.pi)
    cameras = {}
    for name, side in zip(VIDEO_CAMERAS, (-1, 1), strict=True):
        azimuth, tilt = facing + side * rng.uniform(0.62, 0.78), np.radians(rng.uniform(26, 34))
        direction = np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
        target = np.array([0, 0, 0.10])
        T_world_cam = look_at(target + rng.uniform(0.82, 0.90) * direction, target, rng.uniform(-0.03, 0.03))
        cameras[name] = _camera(size, 1.2, T_world_cam)
    return cameras


def look_at(position: Array, target: Array, roll: float = 0.0) -> Array:
    """Return T_world_cam, shape (4, 4), of an OpenCV camera at `position` that looks at `target`.

    Args:
        position: Optical centre, world [m], shape (3,).
        target: Seen in the middle of the image, world [m], shape (3,); not straight above or below.
        roll: Turn about the optical axis [rad].
    """
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cosine, sine = np.cos(roll), np.sin(roll)
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = np.stack([cosine * right + sine * down, cosine * down - sine * right, forward], axis=1)
    T_world_cam[:3, 3] = position
    return T_world_cam


def _camera(size: tuple[int, int], focal_per_width: float, T_world_cam: Array) -> Camera:
    width, height = size
    focal_px = focal_per_width * width
    K = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    return Camera(width=width, height=height, K=K, distortion=np.zeros(0), T_world_cam=T_world_cam)
