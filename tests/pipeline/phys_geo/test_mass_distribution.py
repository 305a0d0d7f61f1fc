"""Where a body's mass is: any second moments are those of a body, and a hidden weight is found from impacts."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets import Track
from cgwm.datasets.capture.manifest import write_manifest
from cgwm.datasets.capture.tracks import Episode, tracks_csv
from cgwm.pipeline.fit import fit
from cgwm.pipeline.phys_geo.tracks import contact_shooting
from cgwm.pipeline.phys_geo.tracks.contact_result import FitRecord
from cgwm.pipeline.phys_geo.tracks.inertia_fit import fit_mass_distribution
from cgwm.pipeline.phys_geo.tracks.part_choice import choose_parts, without_contradicted, without_number
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.engine import rollout as roll_out
from cgwm.pipeline.physics.parameters import CONTACT_PARAMETERS, apply_parameters, mass_distribution, scaled_inertia
from cgwm.pipeline.segments.flight_check import flights_contradict, rises
from cgwm.pipeline.segments.held_out_gain import FOLDS, ContactLinearization
from cgwm.pipeline.synthesize.parameters import draw_parameters
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import (
    Body,
    BoxShape,
    CaptureManifest,
    FitChoice,
    FittedParameter,
    Ground,
    InputDataError,
    PhysConfig,
    Shape,
    UsageError,
    World,
)
from helpers import diagnosis_data
from helpers.worlds import batch, box_body, law, state_of, times, world_of
from scipy.spatial.transform import Rotation

NOISE = Noise(0.0003, 0.003)
STEP_S = 0.002
COM_M = (0.003, -0.002, 0.006)
MOMENTS = (1.4, 1.2, 1.8)
CONTACT = list(zip(CONTACT_PARAMETERS, (0.2, 0.003, 0.5), strict=True))


def weighted_world():
    """A box with a weight off its centre, which nobody has told of."""
    parameters = mass_distribution("box", 0.07)
    return apply_parameters(world_of(box_body(), contact=law(), step_s=STEP_S), parameters, batch((*COM_M, *MOMENTS)))


@cache
def tosses(count: int, weighted: bool = True, drag_per_s: float = 0.0) -> list[Episode]:
    world = weighted_world() if weighted else world_of(box_body(), contact=law(), step_s=STEP_S)
    if drag_per_s:
        drag = ActiveEffect.of(load_effect("linear_drag"), {"c": drag_per_s}, world.gravity[0, :1])
        world = replace(world, effects=(drag,))
    rng = np.random.default_rng(0)
    episodes = []
    for number in range(count):
        quat, spin = rng.standard_normal(4), 8 * rng.standard_normal(3)
        start = state_of(((0, 0, 0.11), tuple(quat), (0.5, 0.2, -0.7), tuple(spin)))
        rollout = roll_out(world, start, times(0.2, 120))
        position = rollout.position_m[0, :, 0].numpy()
        turned = Rotation.from_quat(rollout.quat_wxyz[0, :, 0].numpy(), scalar_first=True)
        turned = turned * Rotation.from_rotvec(NOISE[1] * rng.standard_normal(position.shape))
        noisy = position + NOISE[0] * rng.standard_normal(position.shape)
        track = Track(rollout.times_s.numpy(), noisy, turned.as_quat(scalar_first=True))
        episodes.append(Episode(str(number), {"box": track}))
    return episodes


def test_the_centre_of_mass_stays_within_half_of_the_body() -> None:
    *centre, x, y, z = mass_distribution("cube", 0.2)
    assert [p.name for p in (*centre, x, y, z)] == [
        *(f"cube.com_{axis}_m" for axis in "xyz"),
        *(f"cube.moment_{axis}" for axis in "xyz"),
    ]
    for parameter in centre:
        assert parameter.bounds == pytest.approx((-0.1, 0.1)) and parameter.prior == pytest.approx((0.0, 0.05))
    for parameter in (x, y, z):  # ten times either way, on a logarithmic scale about what the shape says
        assert parameter.logarithmic and parameter.bounds == (0.1, 10.0) and parameter.prior == (1.0, 0.5)


def test_second_moments_scale_as_those_of_a_stretched_box() -> None:
    """A box that is s times longer along x, at equal mass, has s^2 times the second moment along x and no other."""
    short, long = box_body((0.05, 0.04, 0.03)), box_body((0.10, 0.04, 0.03))
    scaled = scaled_inertia(short.inertia, batch((4.0, 1.0, 1.0)))
    torch.testing.assert_close(scaled, long.inertia, rtol=1e-12, atol=0.0)


def test_any_factors_give_an_inertia_that_a_body_can_have() -> None:
    """Principal moments are positive, and none is larger than the other two together."""
    rng = np.random.default_rng(1)
    turn = torch.as_tensor(Rotation.random(rng=rng).as_matrix())
    inertia = turn @ box_body().inertia @ turn.T
    factors = torch.as_tensor(10 ** rng.uniform(-1, 1, (500, 3)))
    principal = torch.linalg.eigvalsh(scaled_inertia(inertia, factors))
    assert float(principal.min()) > 0
    assert bool((principal[:, 2] <= principal[:, :2].sum(-1) * (1 + 1e-12)).all())


def test_a_hidden_weight_is_found_from_tosses() -> None:
    found = fit_mass_distribution(world_of(box_body(), step_s=STEP_S), tosses(10), CONTACT, NOISE)
    numbers = {parameter.name: parameter for parameter in found.parameters}
    truth = {f"box.com_{axis}_m": value for axis, value in zip("xyz", COM_M, strict=True)}
    truth |= {f"box.moment_{axis}": value for axis, value in zip("xyz", MOMENTS, strict=True)}
    assert set(numbers) == set(truth)
    for name, value in truth.items():
        parameter = numbers[name]
        assert parameter.std_error is not None
        assert abs(parameter.estimate - value) < 4 * parameter.std_error + (5e-4 if name.endswith("_m") else 0.05)
    expected = weighted_world().bodies[0]
    torch.testing.assert_close(found.world.bodies[0].inertia, expected.inertia, rtol=0.1, atol=1e-5)


def chosen(world, episodes, **settings) -> tuple[str, ...] | None:
    choice = choose_parts(world, episodes, NOISE, PhysConfig(**settings))
    return None if choice is None else choice.chosen


def test_held_out_tosses_choose_a_hidden_weight_and_nothing_else() -> None:
    """A box with a weight needs its centre of mass; one without, fitted to the same kind of tosses, needs nothing."""
    plain = world_of(box_body(), step_s=STEP_S)
    found = chosen(plain, tosses(10)) or ()
    assert "centre_of_mass" in found and "length_scale" not in found
    assert chosen(plain, tosses(10, weighted=False)) == ()


def test_a_force_in_flight_is_no_mass_distribution_and_is_said() -> None:
    choice = choose_parts(world_of(box_body(), step_s=STEP_S), tosses(10, False, 4.0), NOISE, PhysConfig())
    assert choice is not None and not choice.chosen
    assert "A force in flight, as linear_drag" in choice.sentence and "cgwm diagnose" in choice.sentence


def test_nothing_is_chosen_from_few_tosses_or_against_the_settings() -> None:
    plain = world_of(box_body(), step_s=STEP_S)
    assert chosen(plain, tosses(10)[:7]) is None
    assert chosen(plain, tosses(10), mass_distribution=False, length_scale=False) is None
    centroids = [Episode(name, {"box": replace(tracks["box"], quat_wxyz=None)}) for name, tracks in tosses(10)[:8]]
    assert chosen(plain, centroids) is None


def test_gains_are_those_of_a_step_from_other_episodes() -> None:
    """Of exactly quadratic misfits: the gain is the fall at the others' optimum, and below 0 for noise alone."""
    rng = np.random.default_rng(3)
    truth, slopes = np.array([0.5, -1.0]), rng.standard_normal((40, 6, 2))
    information = slopes.transpose(0, 2, 1) @ slopes

    def linear(at: np.ndarray) -> ContactLinearization:
        rows = slopes @ at + rng.standard_normal((40, 6))
        return ContactLinearization(
            names=("a", "b"),
            base=1,
            information=information,
            score=(slopes.transpose(0, 2, 1) @ rows[..., None])[..., 0],
            prior=(np.zeros(2), np.full(2, 1e-9)),
            excess=1.0,
            misfit=float((rows**2).sum()) / 2,
        )

    found = linear(truth).gain([1])
    expected = 0.5 * sum(m[1, 1] - m[0, 1] ** 2 / m[0, 0] for m in information)
    assert found.matters and found.by_episode.sum() == pytest.approx(expected, rel=0.3)
    null = np.mean([linear(np.array([0.5, 0.0])).gain([1]).by_episode.sum() for _ in range(200)])
    assert null == pytest.approx(-0.5 * FOLDS / (FOLDS - 1), abs=0.15)


def test_a_part_that_did_not_converge_is_a_warning() -> None:
    record = FitRecord(episodes=8, search_episodes=8, noise_estimated=NOISE, mass_distribution={"converged": True})
    assert record.unconverged() == []
    (text,) = replace(record, effects={"in_flight": {"costs": []}, "converged": False}).unconverged()
    assert text.startswith("the fit of the effects did not converge within its steps")
    assert "--set" not in text  # no setting changes these steps


def test_few_episodes_and_centroids_are_refused() -> None:
    with pytest.raises(InputDataError, match="7 of 7 episodes"):
        fit_mass_distribution(world_of(box_body()), tosses(10)[:7], CONTACT, NOISE)
    centroids = [Episode(name, {"box": replace(tracks["box"], quat_wxyz=None)}) for name, tracks in tosses(10)[:8]]
    with pytest.raises(InputDataError, match="0 of 8 episodes"):
        fit_mass_distribution(world_of(box_body()), centroids, CONTACT, NOISE)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("weighted") / "capture"
    (root / "tracks").mkdir(parents=True)
    episodes = tosses(10)[:8]
    for name, tracks in episodes:
        (root / "tracks" / f"{name}.csv").write_text(tracks_csv(tracks), encoding="utf-8")
    box = Body(name="box", mass_kg=0.4, shape=Shape(box=BoxShape(half_extents_m=(0.05, 0.04, 0.03))))
    manifest = CaptureManifest(
        format="cgwm-capture/1",
        world=World(ground=Ground()),
        bodies=(box,),
        splits={"train": tuple(name for name, _ in episodes)},
    )
    write_manifest(root / "capture.toml", manifest)
    return root


# In the suite: the fit and the choice are tested above.
@pytest.mark.evidence
def test_a_model_holds_the_mass_distribution_that_was_fitted(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contact_shooting, "SHOT_ITERATIONS", 1)  # the mass is fitted before
    config = PhysConfig(
        population=8, generations=2, iterations=1, step_s=STEP_S, mass_distribution=True, length_scale=False
    )
    file = fit(capture, tmp_path / "model", phys_config=config)
    numbers = {parameter.name: parameter for parameter in file.parameters}
    assert file.bodies[0].com_m == tuple(numbers[f"box.com_{axis}_m"].estimate for axis in "xyz")
    np.testing.assert_allclose(file.bodies[0].com_m, COM_M, atol=2e-3)
    assert {numbers[f"box.{name}"].state for name in ("com_z_m", "moment_z")} == {"fitted"}
    np.testing.assert_allclose(file.bodies[0].inertia_kg_m2[:3], _diagonal(weighted_world()), rtol=0.2)
    contact, mass = file.correlations
    assert contact.parameters[:3] == ("friction", "contact_time_s", "damping_ratio")
    names = {f"box.com_{axis}_m" for axis in "xyz"} | {f"box.moment_{axis}" for axis in "xyz"}
    assert set(mass.parameters) == names
    for block in file.correlations:
        matrix = np.array(block.matrix)
        np.testing.assert_allclose(np.diag(matrix), 1, rtol=1e-9)
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-9)
        assert np.linalg.eigvalsh(matrix).min() > -1e-9 and np.abs(matrix - np.eye(len(matrix))).max() > 0.01
    drawn, entries = draw_parameters(file, 1.0, np.random.default_rng(0))  # all of it varies in rollouts
    assert drawn.bodies[0].inertia_kg_m2 != file.bodies[0].inertia_kg_m2
    assert all(entry.value != entry.estimate for entry in entries if entry.name in mass.parameters)


@pytest.mark.parametrize(("moment", "stays"), [(1.02, False), (0.9, True)])
def test_a_part_without_a_number_is_not_taken_over(moment: float, stays: bool) -> None:
    every = mass_distribution("ball", 0.07)[3:]
    fitted = [
        FittedParameter(name=p.name, unit=p.unit, estimate=moment, std_error=0.02, bounds=p.bounds, state="fitted")
        for p in every
    ]
    choice = FitChoice(episodes=14, chosen=("second_moments",), tested=(), sentence="chosen")
    found = without_number(choice, fitted, {p.name: 1.0 for p in every})
    assert bool(found.chosen) == stays and ("no number" in found.sentence) != stays


def test_images_do_not_show_where_the_mass_is(capture: Path, tmp_path: Path) -> None:
    config = PhysConfig(supervise="both", mass_distribution=True)
    with pytest.raises(UsageError, match="mass_distribution with --supervise both"):
        fit(capture, tmp_path / "model", phys_config=config)
    assert not (tmp_path / "model").exists()


def _diagonal(world) -> np.ndarray:
    return world.bodies[0].inertia[0].diagonal().numpy()


def test_moments_that_flights_contradict_are_not_taken_over() -> None:
    box = world_of(box_body(), contact=law(), step_s=STEP_S)
    wrong = apply_parameters(box, mass_distribution("box", 0.07)[3:], batch((1.0, 1.0, 1.3)))
    flying = [Episode(*one) for one in diagnosis_data.tosses(box, 1, count=6, duration_s=0.4, height_m=(1.0, 1.2))]
    assert flights_contradict(box, wrong, flying, NOISE)
    assert not flights_contradict(box, box, flying, NOISE)


@pytest.mark.parametrize(
    ("changes", "contradicted"),
    [
        ([900.0, 20.0, 25.0, -1.0], True),
        ([200.0, -5.0, -8.0, -9.0], False),
        ([9.0, 8.0], False),
        ([50.0], False),
        ([], False),
    ],
)
def test_a_rise_of_chi2_counts_where_most_episodes_show_it(changes: list[float], contradicted: bool) -> None:
    assert rises(changes, 1.0) == contradicted


def test_a_part_that_is_contradicted_is_said_not_to_be_fitted() -> None:
    choice = FitChoice(episodes=8, chosen=("centre_of_mass", "second_moments"), tested=(), sentence="")
    left = without_contradicted(choice, "second_moments")
    assert left.chosen == ("centre_of_mass",)
    assert "flights" in left.sentence and left.sentence.endswith("; the centre of mass is fitted, too.")
    assert without_contradicted(left, "centre_of_mass").sentence.endswith("as before.")
