"""Photos of one object, before a background or on a table, with the errors of a real camera and known cameras.

A scanned object is drawn under a lamp, with gloss where asked, through a lens with barrel distortion; then blur, noise
of the sensor and JPEG. A turntable turns the object before a camera that stands; in hand, the camera goes around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.shapes.meshes import Mesh
from cgwm.datasets.synthetic.rig import look_at
from mesh_photos import Painted, draw_parts
from numpy.typing import NDArray

Array = NDArray[np.float64]

WIDTH, HEIGHT = 640, 480
_BLUR_PX, _NOISE, _JPEG = 0.6, 2.0, 92
_CARDS, _SIDE = 7, 512
_MIDDLES = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
"""From places in a photo, whose first pixel has its middle at 0.5, to OpenCV's, where that is 0."""
_BACKDROP = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "clutter": (0.0, 0.0, 0.0)}


@dataclass(frozen=True, kw_only=True)
class Session:
    """How one object is photographed."""

    count: int
    """Number of photos."""
    focal_px: float
    """Focal length [px] at 640 x 480; the distance to the object grows with it."""
    k1: float
    """Radial distortion of the lens."""
    motion: Literal["turntable", "hand"]
    """The object turns before a standing camera in steps of one angle, from two heights; or the camera is carried."""
    background: Literal["black", "white", "clutter"]
    """One colour, or a table with printed things that do not turn with the object."""
    gloss: float
    """Share of mirrored light [1]."""
    seed: int
    """Of the places, the clutter and the noise."""
    lamp_deg: float = 0.0
    """Angle by which the lamp is turned about the vertical."""


def poses(session: Session, mesh: Mesh) -> list[Array]:
    """Return T_object_cam (4, 4) of each photo: its camera in the frame of the object [m]."""
    rng = np.random.default_rng([session.seed, 1])
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    middle, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    distance = session.focal_px * radius / (0.42 * HEIGHT)
    lower = session.count // 2  # photos of the lower ring; the upper one follows, seen from between its places
    around = np.concatenate(
        [np.arange(lower) / lower, (np.arange(session.count - lower) + 0.5) / (session.count - lower)]
    )
    angles, rise = 2 * np.pi * around, np.radians(np.where(np.arange(session.count) < lower, 18.0, 36.0))
    if session.motion == "turntable":
        jitter, shift = np.zeros((session.count, 3)), np.zeros((session.count, 3))
    else:
        jitter = rng.normal(0, [0.05, 0.08, 0.06], (session.count, 3))
        shift = rng.normal(0, 0.1 * radius, (session.count, 3))
    places = []
    for k in range(session.count):
        a, e, d = angles[k] + jitter[k, 0], rise[k] + jitter[k, 1], distance * (1 + jitter[k, 2])
        way = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
        places.append(look_at(middle + d * way, middle + shift[k]))
    return places


def photograph(painted: Painted, session: Session) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]]:
    """Return the photos (H, W, 3), sRGB, and masks (H, W): 1 where the object is."""
    rng = np.random.default_rng([session.seed, 2])
    photos, masks = [], []
    places = poses(session, painted.mesh)
    for place in places:
        image, mask = _shaded(painted, _ideal(session, place), session, place)
        if session.background == "clutter":
            # on a turntable the table stands; the camera does, too, and is raised once
            first = places[0 if len(photos) < session.count // 2 else session.count // 2]
            behind = _table(session, painted.mesh, place if session.motion == "hand" else first)
            image = np.where(mask[..., None] > 0, image, behind)
        photos.append(_developed(image, session, rng))
        masks.append(_through_lens(mask, session, cv2.INTER_NEAREST))
    return photos, masks


def camera_matrix(session: Session) -> Array:
    """Return K [px], shape (3, 3), of the photos."""
    return np.array([[session.focal_px, 0, WIDTH / 2 + 4.0], [0, session.focal_px, HEIGHT / 2 - 3.0], [0, 0, 1]])


def _ideal(session: Session, place: Array) -> Camera:
    return Camera(width=WIDTH, height=HEIGHT, K=camera_matrix(session), distortion=np.zeros(0), T_world_cam=place)


def _shaded(
    painted: Painted, camera: Camera, session: Session, place: Array
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the linear image under a lamp that stands beside the camera's first place, and the object's mask."""
    colors, normals, cover, _ = draw_parts(painted, camera, _BACKDROP[session.background], samples=2)
    turn = np.radians(session.lamp_deg)
    lamp = np.array([0.4 * np.cos(turn) + 0.5 * np.sin(turn), 0.4 * np.sin(turn) - 0.5 * np.cos(turn), 0.75])
    view = place[:3, 3] - painted.mesh.vertices.mean(0)
    half = lamp / np.linalg.norm(lamp) + view / np.linalg.norm(view)
    diffuse = 0.45 + 0.55 * np.clip(normals @ lamp / np.linalg.norm(lamp), 0, 1)
    mirror = session.gloss * np.clip(normals @ half / np.linalg.norm(half), 0, 1) ** 40
    lit = colors * np.where(cover > 0, diffuse, 1.0)[..., None] + (mirror * (cover > 0))[..., None]
    return lit.astype(np.float32), (cover > 0.5).astype(np.uint8)


def _table(session: Session, mesh: Mesh, place: Array) -> NDArray[np.float32]:
    """Return a patterned table with printed cards that stand on it, as the ideal camera at `place` (4, 4) sees them."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    cards, patterns = _cards(session.seed, float(np.linalg.norm(high - low)), *(0.5 * (low + high))[:2], low[2])
    pose = np.linalg.inv(place)
    far = [-float((pose[:3, :3] @ (corner + 0.5 * (u + v)) + pose[:3, 3])[2]) for corner, u, v in cards]
    image = np.full((HEIGHT, WIDTH, 3), 0.35, np.float32)
    for k in [0, *(1 + np.argsort(far[1:]))]:
        corner, u, v = cards[k]
        # the middle of pixel (a, b) of the pattern lies at corner + ((a + 0.5) u + (b + 0.5) v) / side
        plane = np.column_stack([u / _SIDE, v / _SIDE, corner + 0.5 * (u + v) / _SIDE])
        rows = pose[:3, :3] @ plane
        rows[:, 2] += pose[:3, 3]
        homography = _MIDDLES @ camera_matrix(session) @ rows
        cover = cv2.warpPerspective(np.ones((_SIDE, _SIDE), np.float32), homography, (WIDTH, HEIGHT))
        drawn = cv2.warpPerspective(patterns[k], homography, (WIDTH, HEIGHT), flags=cv2.INTER_AREA)
        image = np.where(cover[..., None] > 0.5, drawn, image)
    return image


@lru_cache(maxsize=1)
def _cards(
    seed: int, size: float, x: float, y: float, z: float
) -> tuple[list[tuple[Array, Array, Array]], list[NDArray[np.float32]]]:
    """Return the corner and the sides of the table and of each card, and their patterns; the same in all photos."""
    rng, ground = np.random.default_rng([seed, 3]), np.array([x, y, z])
    cards = [(ground - [1.6 * size, 1.6 * size, 0], np.array([3.2 * size, 0, 0]), np.array([0, 3.2 * size, 0]))]
    for _ in range(_CARDS):
        angle, reach, turn = rng.uniform(0, 2 * np.pi), rng.uniform(0.9, 1.5) * size, rng.uniform(0, np.pi)
        wide, tall = rng.uniform(0.3, 0.6) * size, rng.uniform(0.2, 0.5) * size
        along = wide * np.array([np.cos(turn), np.sin(turn), 0])
        foot = ground + reach * np.array([np.cos(angle), np.sin(angle), 0]) - 0.5 * along
        cards.append((foot, along, np.array([0, 0, tall])))
    patterns = [_pattern(rng) for _ in cards]
    return cards, patterns


def _pattern(rng: np.random.Generator) -> NDArray[np.float32]:
    """Return a pattern (_SIDE, _SIDE, 3) with structure of several sizes."""
    image = np.zeros((_SIDE, _SIDE, 3))
    for sigma in (2, 5, 12):
        layer = cv2.GaussianBlur(rng.normal(size=(_SIDE, _SIDE, 3)), (0, 0), sigma)
        image += layer / layer.std()
    return np.clip(0.5 + 0.17 * image, 0, 1).astype(np.float32)


def _through_lens(image: NDArray, session: Session, how: int = cv2.INTER_LINEAR) -> NDArray:
    """Return an ideal image as a lens with radial distortion draws it."""
    K = camera_matrix(session)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    bent = np.stack([x, y], -1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(bent, K, np.array([session.k1, 0, 0, 0.0]), P=K).reshape(HEIGHT, WIDTH, 2) - 0.5
    x, y = np.moveaxis(straight.astype(np.float32), -1, 0)
    return np.asarray(cv2.remap(image, x, y, how, borderMode=cv2.BORDER_REPLICATE))


def _developed(image: NDArray[np.float32], session: Session, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the photo that a camera makes of an ideal image: lens, blur, noise, JPEG."""
    bent = cv2.GaussianBlur(_through_lens(image, session), (0, 0), _BLUR_PX)
    noisy = 255 * bent.clip(0, 1) + rng.normal(0, _NOISE, bent.shape)
    photo = (noisy.clip(0, 255) + 0.5).astype(np.uint8)
    _, packed = cv2.imencode(".jpg", photo[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)[:, :, ::-1]


def write_photos(folder: Path, photos: list[NDArray[np.uint8]]) -> None:
    """Write the photos as PNG, so that their JPEG artefacts stay those of one encoding."""
    folder.mkdir(parents=True)
    for k, photo in enumerate(photos):
        cv2.imwrite(str(folder / f"{k:03d}.png"), photo[:, :, ::-1])
