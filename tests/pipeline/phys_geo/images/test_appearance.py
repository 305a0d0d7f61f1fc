"""Light on a body that turns, and how a motion tells it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.models.model import Model
from cgwm.datasets.shapes.ply import Splats
from cgwm.pipeline.geometry.rotation import quat_exp, quat_to_matrix
from cgwm.pipeline.phys_geo.images.lighting_fit import (
    PRIOR_MEAN,
    _colored,
    _facing,
    _Frame,
    _in_frame,
    _ratios,
    _rendered,
    _sides,
    fit_light,
)
from cgwm.pipeline.rendering.relighting import Relighting
from cgwm.pipeline.runtime import kernel_build
from cgwm.schemas import Light
from helpers.small_model import small_model

CPU = torch.device("cpu")
LIGHT = Light(lamp=(0.3, -0.4, 0.7), sky=0.15)


def brightness(light: Light, normals: torch.Tensor) -> torch.Tensor:
    return Relighting.of(light, small_model().file.bodies[0], normals).brightness(normals)


def _directions(count: int, seed: int) -> np.ndarray:
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_brightness_is_lamberts_law_with_a_terminator() -> None:
    normals = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], dtype=torch.float64)
    expected = torch.tensor([1 + 0.15 + 0.7, 1 - 0.15, 1 + 0.3, 1.0], dtype=torch.float64)
    torch.testing.assert_close(brightness(LIGHT, normals), expected)


def test_noise_of_normals_does_not_weaken_the_lamp() -> None:
    """Two sides of a box in three poses: with normals that are off by 10 degrees single blocks give too weak a lamp."""
    rng, rows = np.random.default_rng(4), []
    true = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64).repeat_interleave(40, 0)
    for turn in (0.6, 1.2, 2.0):
        turned = quat_to_matrix(quat_exp(torch.tensor([0.0, 0.3, turn], dtype=torch.float64)))
        ratio = (brightness(LIGHT, true @ turned.T) / brightness(LIGHT, true)).numpy()
        rotation = turned.numpy()
        noisy = true.numpy() + rng.normal(0.0, 0.12, true.shape)
        noisy /= np.linalg.norm(noisy, axis=1)[:, None]
        rows.append((ratio, noisy @ rotation.T, noisy))
    blocks = [np.concatenate([row[k] for row in rows]) for k in range(3)]
    sides = [side for row in rows for side in _sides(*row)]
    assert len(sides) == 6
    means = [np.stack([side[k] for side in sides]) for k in range(3)]
    off = [np.linalg.norm(np.subtract(fit_light(*parts, 6).lamp, LIGHT.lamp)) for parts in (blocks, means)]
    assert off[1] < 0.6 * off[0]


def test_light_is_found_from_brightness_ratios_with_outliers() -> None:
    rng = np.random.default_rng(3)
    photo, now = _directions(3000, 4), _directions(3000, 5)
    ratio = (brightness(LIGHT, torch.as_tensor(now)) / brightness(LIGHT, torch.as_tensor(photo))).numpy()
    ratio *= 1 + 0.05 * rng.standard_normal(3000)
    ratio[:300] *= 0.5  # a cast shadow
    found = fit_light(ratio, now, photo, 3000)
    assert found.lamp == pytest.approx(LIGHT.lamp, abs=0.03)
    assert found.sky == pytest.approx(LIGHT.sky, abs=0.03)


def test_what_the_motion_does_not_tell_comes_from_overhead() -> None:
    """A body that did not turn says nothing: every ratio is 1, and the light is the usual one."""
    photo = _directions(500, 6)
    found = fit_light(np.ones(500), photo, photo, 500)
    assert (*found.lamp, found.sky) == pytest.approx(tuple(PRIOR_MEAN), abs=1e-9)


def test_a_surface_is_seen_only_from_its_front() -> None:
    means, eye = torch.zeros(3, 3), torch.tensor([0.0, 0.0, 2.0])
    normals = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.1]])
    assert _facing(means, normals, eye).tolist() == [1.0, 0.0, 0.0]


def test_photos_pose_keeps_its_colours_and_a_turn_does_not() -> None:
    body = small_model().file.bodies[0]
    normals = torch.as_tensor(_directions(200, 7))
    relighting = Relighting.of(LIGHT, body, normals)
    upright = torch.tensor(body.photo_pose.quat_wxyz, dtype=torch.float64)
    torch.testing.assert_close(relighting.factors(upright), torch.ones(200, dtype=torch.float64))
    over = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    expected = brightness(LIGHT, normals @ quat_to_matrix(over).T) / relighting.in_photos
    torch.testing.assert_close(relighting.factors(over), expected)
    assert float(relighting.factors(over).std()) > 0.1


def _ball_filmed(light: Light) -> tuple[Model, Splats, list[_Frame]]:
    """Return a ball's model, its true colours in the light of the photos, and frames of it turning in that light."""
    model = small_model()
    normals = _directions(900, 8)
    albedo = 0.25 + 0.1 * (normals[:, :1] > 0) + 0.1 * np.array([1.0, 0.0, -1.0]) * (normals[:, 1:2] > 0)
    body = model.file.bodies[0]
    relighting = Relighting.of(light, body, torch.as_tensor(normals))
    colors = albedo * relighting.in_photos.numpy()[:, None]
    ball = Splats(
        means=0.05 * normals, scales=np.full(900, 0.003), opacities=np.full(900, 0.95), colors=colors, normals=normals
    )
    camera = Camera(
        width=96,
        height=72,
        K=np.array([[150.0, 0, 48], [0, 150, 36], [0, 0, 1]]),
        distortion=np.zeros(0),
        T_world_cam=np.eye(4),
    )
    position = torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64)
    frames = []
    for quat in np.random.default_rng(9).standard_normal((24, 4)):
        rotation = quat_to_matrix(torch.as_tensor(quat / np.linalg.norm(quat)))
        blank = _Frame(
            body=0,
            normals=normals,
            image=np.zeros((72, 96, 3)),
            usable=np.ones((72, 96), bool),
            camera=camera,
            rotation=rotation,
            position=position,
        )
        lit = torch.as_tensor(colors) * relighting.turned(rotation)[:, None]
        picture = _rendered(_in_frame(ball, blank, lit.float()), camera)
        usable = picture.alpha[0].numpy() > 0.97
        frames.append(replace(blank, image=picture.features[0].double().numpy(), usable=usable))
    return replace(model, body_splats={body.name: ball}), ball, frames


def test_light_is_found_from_frames_of_a_turning_ball() -> None:
    model, ball, frames = _ball_filmed(LIGHT)
    rows = [_ratios(model, frame, {"cube": np.ones(len(ball), bool)}, CPU) for frame in frames]
    ratio, now, photo = (np.concatenate([row[k] for row in rows if row is not None]) for k in range(3))
    found = fit_light(ratio, now, photo, 3 * len(rows))
    directions = torch.as_tensor(_directions(500, 10))
    np.testing.assert_allclose(brightness(found, directions), brightness(LIGHT, directions), atol=0.12)


def test_sides_that_no_photo_shows_get_their_colours_from_the_frames() -> None:
    model, ball, frames = _ball_filmed(LIGHT)
    assert ball.normals is not None
    seen = ball.normals[:, 2] > -0.5
    hidden = replace(ball, colors=np.where(seen[:, None], ball.colors, 0.9))
    model = replace(model, body_splats={"cube": hidden})
    found = _colored(model, 0, frames, LIGHT, seen, CPU)
    np.testing.assert_array_equal(found.colors[seen], hidden.colors[seen])
    error = np.abs(found.colors - ball.colors)[~seen]
    assert np.median(error) < 0.03
    # without frames, the mean of what is seen stands in, as bright as that side would be
    blind = _colored(model, 0, [], LIGHT, seen, CPU)
    assert np.median(np.abs(blind.colors - ball.colors)[~seen]) < 0.12


@pytest.mark.skipif(not kernel_build.available(), reason="needs a CUDA device and cuda-core")
def test_light_and_colours_are_the_same_on_a_gpu() -> None:
    model, ball, frames = _ball_filmed(LIGHT)
    assert ball.normals is not None
    seen, device = ball.normals[:, 2] > -0.5, torch.device("cuda")
    for frame in frames[:4]:
        both = [_ratios(model, frame, {"cube": seen}, where) for where in (CPU, device)]
        for expected, found in zip(*(one or () for one in both), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-4)
    expected, found = (_colored(model, 0, frames, LIGHT, seen, where) for where in (CPU, device))
    np.testing.assert_allclose(found.colors, expected.colors, atol=1e-4)
