"""Photos of a mesh whose surface is known: clean, with true masks and true metric cameras, from all around.

The mesh floats before one plain colour, so that its underside is seen as well as its top. A z-buffer with 3 x 3 samples
a pixel draws it in its own colours, without light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from cgwm.datasets.capture.cameras import Camera, to_intrinsics
from cgwm.datasets.capture.images import write_image
from cgwm.datasets.shapes.meshes import Mesh
from cgwm.datasets.synthetic.objects import make_object
from cgwm.datasets.synthetic.rig import look_at, make_paint
from cgwm.pipeline.geometry.directions import fibonacci_directions
from cgwm.schemas import CamerasFile, PosedImage, Scale
from numpy.typing import NDArray

Array = NDArray[np.float64]

SAMPLES = 3
BACKDROP = (0.62, 0.64, 0.66)
_DISTANCE, _FILLS = 4.0, 0.92
_CHUNK = 3_000_000


@dataclass(frozen=True)
class Painted:
    """A mesh and the colours of its surface.

    Attributes:
        mesh: The surface [m].
        color: Given faces (n,) and barycentric coordinates (n, 3), colours in [0, 1], shape (n, 3).
    """

    mesh: Mesh
    color: Callable[[NDArray[np.int64], Array], NDArray[np.float32]]


def built_in(seed: int) -> Painted:
    """Return an object of the built-in scenes in its paint."""
    solid = make_object(seed)
    mesh = Mesh(solid.vertices, np.asarray(solid.faces, np.int64))
    paint = make_paint(np.random.default_rng([seed, 6]), solid)
    corners = mesh.corners()
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def color(face: NDArray[np.int64], weight: Array) -> NDArray[np.float32]:
        points = np.einsum("nk,nkx->nx", weight, corners[face]).astype(np.float32)
        return paint.albedo(points, normals[face].astype(np.float32), np.full(len(face), 1e-4, np.float32))

    return Painted(mesh, color)


def scanned(folder: Path) -> Painted:
    """Return a scan with its texture: `textured.obj` and `texture_map.png`."""
    vertices, coordinates, faces, corners = [], [], [], []
    for line in (folder / "textured.obj").read_text(encoding="utf-8").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] == ["vt"]:
            coordinates.append([float(word) for word in words[1:3]])
        elif words[:1] == ["f"]:
            pairs = [word.split("/") for word in words[1:4]]
            faces.append([int(pair[0]) - 1 for pair in pairs])
            corners.append([int(pair[1]) - 1 for pair in pairs])
    texture = np.asarray(cv2.imread(str(folder / "texture_map.png")))[..., ::-1].astype(np.float32) / 255
    height, width = texture.shape[:2]
    uv = np.array(coordinates)[np.array(corners)]

    def color(face: NDArray[np.int64], weight: Array) -> NDArray[np.float32]:
        u, v = np.einsum("nk,nkx->xn", weight, uv[face])
        columns, rows = (u * width - 0.5).astype(np.float32), ((1 - v) * height - 0.5).astype(np.float32)
        parts = [
            cv2.remap(texture, columns[k : k + 8192, None], rows[k : k + 8192, None], cv2.INTER_LINEAR)[:, 0]
            for k in range(0, len(face), 8192)
        ]
        return np.concatenate([np.zeros((0, 3), np.float32), *parts], dtype=np.float32)

    return Painted(Mesh(np.array(vertices), np.array(faces, np.int64)), color)


def cameras_around(mesh: Mesh, count: int, size: int) -> dict[str, Camera]:
    """Return cameras in all directions, evenly spread, that see all of the mesh."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    middle = 0.5 * (low + high)
    radius = float(np.linalg.norm(mesh.vertices - middle, axis=1).max())
    focal = _FILLS * 0.5 * size * np.sqrt(_DISTANCE**2 - 1)
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    # in an order that goes everywhere early, so that every eighth is not one ring
    order = np.random.default_rng(0).permutation(count)
    directions = fibonacci_directions(count)[order]
    return {
        f"{index:03d}.png": Camera(
            width=size,
            height=size,
            K=K,
            distortion=np.zeros(0),
            T_world_cam=look_at(middle + _DISTANCE * radius * way, middle),
        )
        for index, way in enumerate(directions)
    }


def write_capture(root: Path, painted: Painted, views: int, size: int, depth_noise_m: float | None = None) -> None:
    """Write a capture of one body, `object`, whose frame in the photos is the mesh's.

    Args:
        root: The directory to make.
        painted: The body.
        views: Number of photos.
        size: Their sides [px].
        depth_noise_m: Standard deviation of the noise of depth maps [m]; None writes no depth maps.
    """
    rng = np.random.default_rng(0)
    cameras = cameras_around(painted.mesh, views, size)
    (root / "images").mkdir(parents=True)
    (root / "masks").mkdir()
    for name, camera in cameras.items():
        image, mask, depth = draw(painted, camera)
        if depth_noise_m is not None:
            (root / "depth").mkdir(exist_ok=True)
            noisy = np.where(depth > 0, depth + depth_noise_m * rng.normal(size=depth.shape), 0)
            np.save(root / "depth" / name.replace(".png", ".npy"), noisy.astype(np.float32))
        write_image(root / "images" / name, image)
        write_image(root / "masks" / name, mask)
    file = CamerasFile(
        scale=Scale(kind="metric", source="truth", relative_std=0.0),
        cameras={"camera": to_intrinsics(next(iter(cameras.values())))},
        images={
            name: PosedImage(camera="camera", T_world_cam=tuple(map(tuple, camera.T_world_cam.tolist())))  # type: ignore[arg-type]
            for name, camera in cameras.items()
        },
    )
    (root / "cameras.json").write_text(file.model_dump_json() + "\n", encoding="utf-8")
    manifest = 'format = "cgwm-capture/1"\n[[bodies]]\nname = "object"\n'
    (root / "capture.toml").write_text(manifest, encoding="utf-8")


def draw(painted: Painted, camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Array]:
    """Return a photo (H, W, 3), its mask (H, W): 1 where most of a pixel shows the mesh, and the depth [m] (H, W)."""
    image, _, cover, depths = draw_parts(painted, camera)
    return (image.clip(0, 1) * 255 + 0.5).astype(np.uint8), (cover > 0.5).astype(np.uint8), depths


def draw_parts(
    painted: Painted, camera: Camera, backdrop: tuple[float, float, float] = BACKDROP, samples: int = SAMPLES
) -> tuple[NDArray[np.float32], Array, Array, Array]:
    """Return what a camera sees of a mesh, without light.

    Args:
        painted: The mesh and its colours.
        camera: A camera without lens distortion.
        backdrop: Colour of pixels that show no mesh, in [0, 1].
        samples: Samples a pixel along each axis.

    Returns:
        The colours (H, W, 3), averaged over the samples of a pixel; at the middle of each pixel the outward normal of
        the face (H, W, 3) and the depth [m] (H, W), 0 where no mesh is seen; between them the share of each pixel that
        shows the mesh (H, W): colours, normals, cover, depth.
    """
    width, height = samples * camera.width, samples * camera.height
    pixel, depth = camera.resized(width, height).project(painted.mesh.vertices)
    face, weight, place = _visible(pixel, depth, painted.mesh.faces, width, height)
    fine = np.tile(np.array(backdrop, np.float32), (height * width, 1))
    fine[place] = painted.color(face, weight)
    covered, depths, normals = np.zeros(height * width), np.zeros(height * width), np.zeros((height * width, 3))
    covered[place] = 1
    depths[place] = (weight * depth[painted.mesh.faces[face]]).sum(1)
    corners = painted.mesh.corners()
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals[place] = (normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30))[face]
    shape = (camera.height, samples, camera.width, samples)
    middle = slice(samples // 2, None, samples)
    return (
        fine.reshape(*shape, 3).mean((1, 3)),
        normals.reshape(height, width, 3)[middle, middle],
        covered.reshape(shape).mean((1, 3)),
        depths.reshape(height, width)[middle, middle],
    )


def _visible(
    pixel: Array, depth: Array, faces: NDArray[np.int64], width: int, height: int
) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
    """Return which face (n,) is nearest, and where on it (n, 3), at the pixels `place` (n,) that show any."""
    corners = pixel[faces]
    low = np.maximum(np.ceil(corners.min(1) - 0.5), 0).astype(int)
    high = np.minimum(np.floor(corners.max(1) - 0.5), [width - 1, height - 1]).astype(int)
    extent = high - low + 1
    drawn = np.flatnonzero((extent > 0).all(1))
    nearest = np.zeros(width * height)
    winner = np.full(width * height, -1)
    # Faces of about one shape are drawn together.
    shape = np.ceil(np.log2(np.maximum(extent, 1))).astype(int)
    for part in _chunks(drawn, shape):
        columns, rows = extent[part].max(0)
        x = low[part, 0, None, None] + np.arange(columns)
        y = low[part, 1, None, None] + np.arange(rows)[:, None]
        weight = _weights(corners[part][:, None, None], x + 0.5, y + 0.5)
        inverse = (weight / depth[faces[part]][:, None, None]).sum(-1)
        hit = (weight >= 0).all(-1) & (x < width) & (y < height)
        place = (y * width + x)[hit]
        value, owner = inverse[hit], np.broadcast_to(part[:, None, None], hit.shape)[hit]
        first = np.argsort(value, kind="stable")
        place, value, owner = place[first], value[first], owner[first]
        # of equal places the last, which is the nearest, stays
        before = nearest[place] < value
        place, value, owner = place[before], value[before], owner[before]
        nearest[place], winner[place] = value, owner
    place = np.flatnonzero(winner >= 0)
    face = winner[place]
    screen = _weights(corners[face], place % width + 0.5, place // width + 0.5)
    weight = screen / depth[faces[face]]
    return face, weight / weight.sum(1, keepdims=True), place


def _chunks(drawn: NDArray[np.int64], shape: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return faces whose extents have the same powers of 2 (face, 2), in parts of at most `_CHUNK` pixels or one."""
    parts = []
    for columns, rows in np.unique(shape[drawn], axis=0):
        alike = drawn[(shape[drawn] == (columns, rows)).all(1)]
        count = max(1, _CHUNK >> int(columns + rows))
        parts += [alike[k : k + count] for k in range(0, len(alike), count)]
    return parts


def _weights(corners: Array, x: NDArray[Any], y: NDArray[Any]) -> Array:
    """Return barycentric coordinates in the image (..., 3) of points in triangles with corners (..., 3, 2)."""
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    area = (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
    safe = np.where(np.abs(area) > 1e-12, area, np.inf)
    second = ((x - a[..., 0]) * (c[..., 1] - a[..., 1]) - (y - a[..., 1]) * (c[..., 0] - a[..., 0])) / safe
    third = ((b[..., 0] - a[..., 0]) * (y - a[..., 1]) - (b[..., 1] - a[..., 1]) * (x - a[..., 0])) / safe
    outside = np.where(np.isinf(safe), -1.0, 0.0)
    return np.stack([1 - second - third + outside, second, third], -1)
