"""A box that falls flat on a face tells how much energy an impact leaves, whatever it turns the box."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.diagnose.contact.contact_test import ContactData
from cgwm.pipeline.diagnose.contact.flat_impact import FlatImpactTest
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.segments.candidates import Candidate
from cgwm.pipeline.segments.impacts.flat import faces_of, flat_impacts
from cgwm.pipeline.segments.prepare import Prepared, prepare
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.worlds import box_body, law, world_of
from scipy.spatial.transform import Rotation

HALF, MASS, FALL = (0.05, 0.04, 0.03), 0.4, 9.81
WORLD = world_of(box_body(HALF, MASS, 1e-6), contact=law())
NOISE = Noise(2e-4, 1e-3)
TIMES = np.arange(0, 0.75, 0.008)
LIBRARY = [Candidate(name, load_effect(name)) for name in ("velocity_restitution", "adhesion")]


def drops(slope: float, turning: float = 0.3, tilt_rad: float = 0.02) -> Prepared:
    """Return drops from several heights, whose rebound falls with the speed and turns the box."""
    rng, episodes = np.random.default_rng(2), []
    moment = MASS / 3 * (HALF[1] ** 2 + HALF[2] ** 2)
    for number, height in enumerate((0.1, 0.2, 0.4, 0.6, 0.9, 1.2)):
        land = np.sqrt(2 * height / FALL)
        energy = 0.5 * (0.7 * np.exp(-slope * FALL * land) * FALL * land) ** 2
        share = turning * rng.uniform(0, 0.2)
        up, spin = np.sqrt(2 * energy * (1 - share)), np.sqrt(2 * energy * share * MASS / moment)
        since = np.clip(TIMES - land, 0, None)
        z = np.where(TIMES < land, height - 0.5 * FALL * TIMES**2, up * since - 0.5 * FALL * since**2) + HALF[2]
        turn = Rotation.from_rotvec(np.outer(tilt_rad * rng.uniform(-1, 1) + spin * since, [1.0, 0, 0])).as_quat()
        place = np.column_stack((np.zeros((len(TIMES), 2)), z)) + NOISE.position_m * rng.standard_normal(
            (len(TIMES), 3)
        )
        flies = TIMES < land + min(2 * up / FALL, 0.3)
        track = Track(TIMES[flies], place[flies], turn[:, [3, 0, 1, 2]][flies])
        episodes.append(Episode(f"{number}", {"box": track}))
    return prepare(WORLD, episodes, NOISE)


def test_faces_of_a_box_are_as_far_as_its_sides() -> None:
    normals, reaches = faces_of(WORLD.bodies[0])
    assert sorted(map(tuple, np.abs(normals).round(9).tolist())) == sorted(2 * [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
    assert reaches == pytest.approx([HALF[int(np.abs(one).argmax())] for one in normals], abs=1e-5)


@pytest.mark.parametrize("slope", [0.0, 0.12])
def test_flat_drops_name_a_rebound_that_falls_with_the_speed_alone(slope: float) -> None:
    prepared = drops(slope)
    impacts = flat_impacts(prepared, WORLD)
    assert impacts is not None and len(impacts) >= 4
    speed = -impacts.before[:, 2]
    assert torch.allclose(impacts.after[:, 2] / speed, 0.7 * torch.exp(-slope * speed), rtol=0.03)
    data = ContactData(prepared=prepared, world=WORLD, segments=None, sliding=None)
    test = FlatImpactTest()
    evidence = test.evidence(data, LIBRARY)
    assert {one.name for one in evidence} <= {"velocity_restitution"}
    assert any(bar.passed(one) for one in evidence for bar in test.bars([one], data)) == (slope > 0)


@pytest.mark.parametrize("how", [{"turning": 3.0}, {"tilt_rad": 0.4}])
def test_impacts_that_are_askew_or_turn_the_box_are_none(how: dict[str, float]) -> None:
    flat, askew = flat_impacts(drops(0.0), WORLD), flat_impacts(drops(0.0, **how), WORLD)
    assert flat is not None and (0 if askew is None else len(askew)) < len(flat) - 1
