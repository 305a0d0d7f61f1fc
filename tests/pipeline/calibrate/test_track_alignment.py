"""Aligned places of points: a painted plane whose photos are known to the pixel, seen from the side and with gain."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
from cgwm.datasets.synthetic.rig import look_at
from cgwm.pipeline.calibrate import attempts
from cgwm.pipeline.calibrate.colmap.mapping import Mapped, without_outliers
from cgwm.pipeline.calibrate.reconstruction import SfmCamera, SfmModel
from cgwm.pipeline.calibrate.track_alignment import aligned
from numpy.typing import NDArray

WIDTH, HEIGHT = 200, 160
CAMERA = SfmCamera(width=WIDTH, height=HEIGHT, fx=240.0, fy=240.0, cx=100.0, cy=80.0, distortion=(-0.1, 0.0, 0.0, 0.0))
NOISE_PX = 0.4
PLACES = {"a": (-0.5, -0.9), "b": (0.0, -1.0), "c": (0.5, -0.9), "d": (0.25, -0.7)}
PAINT = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(500, 500)), (0, 0), 3.0).astype(np.float32)
PAINT = 120 + 40 * PAINT / PAINT.std()


def _pose(place: tuple[float, float]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.inv(look_at(np.array([*place, 1.0]), np.zeros(3))), np.float64)


def _on_plane(pose: NDArray[np.float64], xy_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where the rays of pixels meet the plane z = 0, shape (n, 2) [m]."""
    ways = np.column_stack([CAMERA.rays(xy_px), np.ones(len(xy_px))]) @ pose[:3, :3]
    center = -pose[:3, :3].T @ pose[:3, 3]
    return center[:2] - ways[:, :2] * (center[2] / ways[:, 2])[:, None]


def _photo(pose: NDArray[np.float64], gain: float) -> NDArray[np.float32]:
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    place = _on_plane(pose, np.stack([columns, rows], -1).reshape(-1, 2)).reshape(HEIGHT, WIDTH, 2)
    x, y = np.moveaxis((250 + 300 * place).astype(np.float32), -1, 0)
    return np.asarray(gain * cv2.remap(PAINT, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), np.float32)


def _scene() -> tuple[SfmModel, dict[str, NDArray[np.float32]]]:
    """Return a model whose observations are noisy in a, b and c and none in d, and its photos."""
    rng = np.random.default_rng(1)
    poses = {name: _pose(place) for name, place in PLACES.items()}
    points = np.column_stack([rng.uniform(-0.25, 0.25, (40, 2)), np.zeros(40)])
    seen = {}
    for name, pose in poses.items():
        count = 0 if name == "d" else 40
        pixels = CAMERA.project(points[:count] @ pose[:3, :3].T + pose[:3, 3]).reshape(-1, 2)
        seen[name] = (pixels + rng.normal(0, NOISE_PX, pixels.shape), np.arange(count))
    model = SfmModel(
        cameras={"photos": CAMERA},
        image_camera=dict.fromkeys(poses, "photos"),
        T_cam_world=poses,
        points=points,
        colors=np.zeros((40, 3), np.uint8),
        observations=seen,
        reprojection_error_px=0.0,
    )
    return model, {name: _photo(pose, 0.8 + 0.1 * k) for k, (name, pose) in enumerate(poses.items())}


def _spread_px(model: SfmModel, images: str) -> float:
    """Return the median distance on the plane between places in photos and in b, the reference [px]."""
    places = {name: np.full((40, 2), np.nan) for name in "b" + images}
    for name, place in places.items():
        pixels, index = model.observations[name]
        place[index] = _on_plane(model.T_cam_world[name], pixels)
    apart = np.concatenate([np.linalg.norm(places[name] - places["b"], axis=1) for name in images])
    return float(np.nanmedian(apart) * CAMERA.fx / 1.4)  # the plane is 1.4 m away


def test_matched_places_agree_on_the_surface_after_alignment() -> None:
    model, photos = _scene()
    after = aligned(model, photos, further=False)
    assert _spread_px(model, "ac") > NOISE_PX and _spread_px(after, "ac") < 0.2 * NOISE_PX
    assert all(len(after.observations[name][1]) == len(model.observations[name][1]) for name in model.T_cam_world)


def test_points_are_found_where_they_were_not_matched_and_not_where_something_covers_them() -> None:
    model, photos = _scene()
    covered = photos | {"d": photos["d"].copy()}
    covered["d"][:, : WIDTH // 2] = PAINT[:HEIGHT, : WIDTH // 2]
    after = aligned(model, covered, further=True)
    pixels, index = after.observations["d"]
    true = CAMERA.project(model.points @ model.T_cam_world["d"][:3, :3].T + model.T_cam_world["d"][:3, 3])
    free = np.flatnonzero(true[:, 0] > WIDTH // 2 + 12)
    assert len(free) > 8 and np.isin(free, index).mean() > 0.9 and pixels[:, 0].min() > WIDTH // 2 - 12
    assert _spread_px(after, "d") < 0.2 * NOISE_PX


def test_other_observations_make_the_same_model_of_colmap() -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 30
    found = Mapped(reconstruction=pycolmap.synthesize_dataset(options), names={1: "photos"})
    model = found.model()
    moved = {name: (xy + 0.25, index) for name, (xy, index) in model.observations.items()}
    again = found.with_observations(replace(model, observations=moved)).model()
    for name, pose in model.T_cam_world.items():
        assert np.allclose(again.T_cam_world[name], pose)
        assert np.allclose(again.observations[name][0], moved[name][0])
    assert np.allclose(again.points, model.points) and again.cameras == model.cameras


def test_a_point_behind_a_camera_is_taken_for_a_wrong_match() -> None:
    """Two photos from one place may triangulate one there; its error was NaN, on which COLMAP's adjustment failed."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 60
    found = Mapped(reconstruction=pycolmap.synthesize_dataset(options), names={1: "photos"})
    point = next(iter(found.reconstruction.points3D.values()))
    image = found.reconstruction.images[point.track.elements[0].image_id]
    point.xyz = 2 * image.projection_center() - point.xyz
    assert np.isinf(found.residuals_px().max()) and not np.isnan(found.residuals_px()).any()
    after = without_outliers(found, {}, 0)
    assert after.image_count == 4 and after.residuals_px().max() < 1e-6


def test_a_model_whose_photo_sees_no_point_is_known_for_it() -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 3, 20
    found = Mapped(reconstruction=pycolmap.synthesize_dataset(options), names={1: "photos"})
    assert attempts._all_seen(found)  # pyright: ignore[reportPrivateUsage]
    model = found.model()
    last = list(model.observations)[-1]
    blind = model.observations | {last: (np.zeros((0, 2)), np.zeros(0, np.int64))}
    assert not attempts._all_seen(found.with_observations(replace(model, observations=blind)))  # pyright: ignore[reportPrivateUsage]


def test_points_of_a_photo_and_its_copy_alone_are_dropped() -> None:
    """Their rays are parallel but for noise: an adjustment moved them to millions of the scene's size."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 6, 80
    found = Mapped(reconstruction=pycolmap.synthesize_dataset(options), names={1: "photos"})
    first, copy = sorted(found.reconstruction.images.values(), key=lambda one: one.name)[:2]
    copy.frame.rig_from_world = first.cam_from_world()
    model, noise = found.model(), np.random.default_rng(0)
    pixels, seen = model.observations[first.name]
    # ten points are seen in these two alone
    few = {name: (xy[index > 9], index[index > 9]) for name, (xy, index) in model.observations.items()}
    both = {name: (pixels + noise.normal(0, 0.1, pixels.shape), seen) for name in (first.name, copy.name)}
    after = without_outliers(found.with_observations(replace(model, observations={**few, **both})), {}, 0).model()
    assert len(after.points) == len(model.points) - np.isin(np.arange(10), seen).sum() > 60
    assert np.linalg.norm(after.points, axis=1).max() < 2 * np.linalg.norm(model.points, axis=1).max()
