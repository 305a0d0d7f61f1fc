"""The principal point is found before observations are dropped as outliers of a wrong one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pycolmap
from cgwm.pipeline.calibrate import attempts
from cgwm.pipeline.calibrate.colmap.mapping import Mapped
from cgwm.pipeline.calibrate.pose_posterior import posterior
from helpers.sfm_scene import look_at

TRUE_PX = np.array([325.0, 236.0])
PHOTOS, POINTS, FOCAL_PX = 8, 120, 600.0


def _taken() -> Mapped:
    """Return what a mapping begins with: poses, points and focal length true, the principal point in the middle."""
    rng = np.random.default_rng(0)
    model, cloud = pycolmap.Reconstruction(), rng.uniform(-0.6, 0.6, (POINTS, 3))
    middle = [FOCAL_PX, 320.0, 240.0, 0.0]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="SIMPLE_RADIAL", width=640, height=480, params=middle, camera_id=1)
    )
    tracks = [pycolmap.Track() for _ in cloud]
    for k in range(PHOTOS):
        angle = 2 * np.pi * k / PHOTOS
        centre = (1.3 + 0.5 * rng.uniform()) * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.3, 0.9)])
        pose = look_at(centre, rng.normal(0, 0.1, 3))
        local = cloud @ pose[:3, :3].T + pose[:3, 3]
        # most places are exact to a tenth of a pixel, the others to half a one: what features of photos are like
        noise = rng.normal(size=(POINTS, 2)) * np.where(rng.random(POINTS) < 0.3, 0.5, 0.1)[:, None]
        pixels = FOCAL_PX * local[:, :2] / local[:, 2:] + TRUE_PX + noise
        places = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in pixels])
        image = pycolmap.Image(name=f"{k:02d}.jpg", camera_id=1, image_id=k + 1, points2D=places)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
        for point, track in enumerate(tracks):
            track.add_element(k + 1, point)
    for position, track in zip(cloud, tracks, strict=True):
        model.add_point3D(position, track, np.zeros(3, np.uint8))
    return Mapped(reconstruction=model, names={1: "photos"})


def test_observations_that_tell_the_principal_point_are_not_dropped() -> None:
    source = SimpleNamespace(image=SimpleNamespace(camera="photos"))
    inputs = SimpleNamespace(sources=(source,), richest={"photos": "OPENCV"}, known={})
    found, lens = attempts._supported(_taken(), "SIMPLE_RADIAL", inputs, 0)  # type: ignore[arg-type]
    model = attempts._with_principal_points(found, lens, inputs, 0).model()  # type: ignore[arg-type]
    camera, after = model.cameras["photos"], posterior(model, {"photos": lens})
    column = after.principal_columns["photos"]
    stds = np.sqrt(after.variances[column : column + 2])
    assert lens == "SIMPLE_RADIAL"  # no tangential distortion takes the place of the principal point
    assert (stds < 1.0).all()
    assert (np.abs(np.array([camera.cx, camera.cy]) - TRUE_PX) < 2 * stds).all()
