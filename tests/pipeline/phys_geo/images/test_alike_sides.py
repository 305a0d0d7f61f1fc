"""Poses from masks of a box are known up to half turns: flights choose those with which one centre of mass falls."""

import itertools

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.datasets.shapes.meshes import Mesh
from cgwm.pipeline.geometry.rotation import matrix_to_quat, quat_exp, quat_multiply, quat_to_matrix
from cgwm.pipeline.phys_geo.images.alike_sides import alike_turns, with_alike_sides
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import world_with

WORLD = world_with("cube", ground=False)
BODY = WORLD.bodies[0].name
NOISE = Noise(2.5e-4, 4e-3)
CORNERS = np.array(list(itertools.product((-0.05, 0.05), (-0.06, 0.06), (-0.07, 0.07))))
OUTLINES = {BODY: Mesh(CORNERS, np.zeros((0, 3), np.int64))}
TURNS = alike_turns(CORNERS)
CENTER = np.array([0.004, -0.003, 0.002])


def filmed(center: np.ndarray, sides: list[int], seed: int = 0) -> list[Episode]:
    """Flights of a box with its centre of mass off its middle, each seen in axes that are turned."""
    rng, t, found = np.random.default_rng(seed), np.arange(21) / 40, []
    gravity = WORLD.gravity[0].numpy()
    for number, side in enumerate(sides):
        start, spin = torch.as_tensor(rng.normal(size=3)), rng.normal(size=3) * 6
        turn = quat_multiply(quat_exp(start)[None], quat_exp(torch.as_tensor(t[:, None] * spin)))
        offset = quat_to_matrix(turn).numpy() @ center
        place = rng.normal(size=3) + t[:, None] * rng.normal(size=3) + 0.5 * gravity * t[:, None] ** 2 - offset
        place = place + NOISE.position_m * rng.normal(size=place.shape)
        seen = quat_multiply(turn, matrix_to_quat(torch.as_tensor(TURNS[side]))[None]).numpy()
        found.append(Episode(f"{number:03}", {BODY: Track(t, place, seen)}))
    return found


def relative(episodes: list[Episode], true: list[Episode]) -> list[np.ndarray]:
    """The turn between the body axes of each episode and the true ones."""
    both = [[e.tracks[BODY].quat_wxyz[0] for e in some] for some in (episodes, true)]  # pyright: ignore[reportOptionalSubscript]
    a, b = (quat_to_matrix(torch.as_tensor(np.array(one))).numpy() for one in both)
    return list(np.swapaxes(b, 1, 2) @ a)


def test_a_box_looks_the_same_after_half_turns_and_a_cube_after_quarter_turns_too() -> None:
    assert len(TURNS) == 4
    assert len(alike_turns(np.array(list(itertools.product((-1.0, 1.0), repeat=3))))) == 24
    lopsided = CORNERS + 0.01 * (CORNERS[:, :1] > 0) * (CORNERS[:, 1:2] > 0)
    assert len(alike_turns(lopsided)) == 1


@pytest.mark.parametrize("wrong", [None, 3])
def test_one_centre_of_mass_tells_the_sides_of_all_episodes(wrong: int | None) -> None:
    true, given = filmed(CENTER, [0] * 6), filmed(CENTER, [2, 0, 1, 3, 0, 1])
    if wrong is not None:  # the side changes in the middle of the flight
        track, other = (one[wrong].tracks[BODY] for one in (given, filmed(CENTER, [2] * 6)))
        assert track.quat_wxyz is not None and other.quat_wxyz is not None
        mixed = np.concatenate([track.quat_wxyz[:10], other.quat_wxyz[10:]])
        given[wrong] = given[wrong]._replace(tracks={BODY: Track(track.time_s, track.position_m, mixed)})
    turned, (warning,) = with_alike_sides(WORLD, given, OUTLINES, NOISE)
    kept = [k for k in range(6) if k != wrong]
    left = relative([turned[k] for k in kept], [true[k] for k in kept])
    assert all(np.allclose(one, left[0], atol=1e-6) for one in left)
    assert np.allclose(turned[0].tracks[BODY].quat_wxyz, given[0].tracks[BODY].quat_wxyz)  # pyright: ignore[reportArgumentType]
    assert "looks the same from 4 sides" in warning


@pytest.mark.parametrize("center", [np.zeros(3), CENTER])
def test_nothing_is_turned_without_need(center: np.ndarray) -> None:
    """With the centre in the middle no turn matters; with the right turns none is better."""
    for seed in range(3):
        sides = [2, 0, 1, 3, 0, 1] if not center.any() else [0] * 6
        given = filmed(center, sides, seed)
        assert with_alike_sides(WORLD, given, OUTLINES, NOISE) == (given, ())


def test_an_even_force_is_no_offset_of_the_centre() -> None:
    """A drag that slows all flights alike has nothing to do with the sides of the box."""
    given = filmed(np.zeros(3), [2, 0, 1, 3, 0, 1])
    for place, episode in enumerate(given):
        track = episode.tracks[BODY]
        pushed = track.position_m + 0.5 * np.array([0.8, 0.0, 0.3]) * track.time_s[:, None] ** 2
        given[place] = episode._replace(tracks={BODY: Track(track.time_s, pushed, track.quat_wxyz)})
    assert with_alike_sides(WORLD, given, OUTLINES, NOISE)[1] == ()
