"""Sampling plans: what is drawn follows the plan, and what its rules reject is drawn again, whatever the sharding."""

import json
import tomllib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from cgwm.datasets.rollouts.dataset import read_manifest
from cgwm.datasets.rollouts.loader import RolloutReader
from cgwm.datasets.rollouts.rollouts import ContactTable, RolloutLabels
from cgwm.pipeline.geometry.viewpoint import rotation_matrix
from cgwm.pipeline.synthesize import synthesize
from cgwm.pipeline.synthesize.distributions import draw
from cgwm.pipeline.synthesize.draw import draw_lighting, draw_rollout
from cgwm.pipeline.synthesize.job import resolved_plan
from cgwm.pipeline.synthesize.parameters import draw_parameters, require_admissible, with_correlations, with_parameter
from cgwm.pipeline.synthesize.plan import extent, resolve_plan
from cgwm.pipeline.synthesize.pusher_paths import push_track
from cgwm.pipeline.synthesize.rejection import Rejection, accepted_rollouts
from cgwm.pipeline.synthesize.start_states import draw_start
from cgwm.pipeline.synthesize.viewpoints import look_at_cameras
from cgwm.schemas import (
    Correlation,
    Distribution,
    EffectModel,
    FitFile,
    FittedParameter,
    InputDataError,
    Light,
    ModelFile,
    NotConvergedError,
    RejectionRules,
    SamplingPlan,
    SynthesizeConfig,
    plan_toml,
    read_plan,
)
from helpers.small_model import HALF, MASS, small_model, write_small_model
from scipy import stats

CONFIG = SynthesizeConfig(rollouts=3, duration_s=0.2, width=48, height=32, device="cpu", seed=5)
UP = np.array([0.0, 0, 1])


def correlated_file(correlation: float = -0.8) -> ModelFile:
    matrix = ((1.0, correlation), (correlation, 1.0))
    block = Correlation(parameters=("friction", "damping_ratio"), matrix=matrix)
    return small_model().file.model_copy(update={"correlations": (block,)})


@pytest.mark.parametrize(
    "given", [0.3, [0.1, 0.4], {"log_uniform": [0.1, 10]}, {"normal": [1, 0.2]}, {"choice": [1, 2, 5]}]
)
def test_draws_stay_in_the_support_and_follow_the_distribution(given: object) -> None:
    distribution = Distribution.model_validate(given)
    low, high = distribution.support
    rng = np.random.default_rng(0)
    values = np.array([draw(distribution, rng) for _ in range(600)])
    assert low <= values.min() and values.max() <= high
    laws = {
        "uniform": lambda: stats.uniform(low, high - low),
        "log_uniform": lambda: stats.loguniform(low, high),
        "normal": lambda: stats.truncnorm(-3, 3, 1, 0.2),
    }
    for kind, law in laws.items():
        if getattr(distribution, kind) is not None:
            assert stats.kstest(values, law().cdf).pvalue > 0.01
    if distribution.choice is not None:
        assert set(values) == {1, 2, 5}
    assert distribution.varies == (len(set(values)) > 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("height = [0, 1]", r"plan.toml, line 1: the top level has an unknown field 'height'[\s\S]*'height_m'"),
        ("views = 2\nheight_m = [0.3, 0.1]", r"line 2: height_m: a range is \[low, high\]; found \[0.3, 0.1\]"),
        ("height_m = [1, 2, 3]", r"height_m: a list is a range \[low, high\]; found 3 values"),
        ("height_m = { uniform = [0, 1], fixed = 2 }", "takes one of .*; found fixed and uniform"),
        ("height_m = { gauss = [0, 1] }", r"height_m\] has an unknown field 'gauss'"),
        ("push_speed_m_s = [-1, 1]", "push_speed_m_s has to lie from 0 to 100000; it reaches from -1 to 1"),
        ("view_elevation_deg = { normal = [80, 5] }", "view_elevation_deg has to lie from -85 to 85"),
        ("[reject]\noff_table = 1", r"\[reject\] has an unknown field 'off_table'[\s\S]*Did you mean 'off_table_m'"),
        ("[parameters]\nfriction = { log_uniform = [0, 1] }", "friction: log_uniform lies above 0"),
    ],
)
def test_a_wrong_plan_is_told_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(text)
    with pytest.raises(InputDataError, match=message):
        read_plan(path)


def test_a_plan_as_text_is_the_plan() -> None:
    plan = SamplingPlan.model_validate(
        {
            "height_m": {"normal": [0.2, 0.01]},
            "view_distance_m": 0.7,
            "reject": {"off_table_m": 0.3, "no_contact": True},
            "parameters": {"cube.mass_kg": {"choice": [0.1, 0.2]}},
        }
    )
    for comments in (True, False):
        assert SamplingPlan.model_validate(tomllib.loads(plan_toml(plan, comments))) == plan
    assert SamplingPlan.model_validate(plan.model_dump()) == plan
    assert "# Gap between" in plan_toml(plan) and "#" not in plan_toml(plan, comments=False)


def test_what_was_fitted_together_is_drawn_together() -> None:
    """The logarithms have the fit's correlation, and each parameter keeps its own distribution."""
    file = correlated_file()
    draws = [draw_parameters(file, 1.0, np.random.default_rng(seed))[1] for seed in range(600)]
    friction, damping = (np.log([entries[k].value for entries in draws]) for k in (0, 1))
    assert np.corrcoef(friction, damping)[0, 1] == pytest.approx(-0.8, abs=0.04)
    assert stats.kstest(friction, stats.norm(np.log(0.4), 0.05 / 0.4).cdf).pvalue > 0.01
    assert stats.kstest(damping, stats.norm(np.log(0.3), 0.02 / 0.3).cdf).pvalue > 0.01
    wide = [draw_parameters(file, 3.0, np.random.default_rng(seed))[1] for seed in range(200)]
    assert np.log([entries[0].value for entries in wide]).std() == pytest.approx(3 * friction.std(), rel=0.15)


def test_joint_draws_stay_within_the_bounds() -> None:
    file = correlated_file(0.95)
    narrow = tuple(p.model_copy(update={"bounds": (0.29, 0.41)}) for p in file.parameters[:2])
    file = file.model_copy(update={"parameters": narrow})
    values = np.array([[e.value for e in draw_parameters(file, 5.0, np.random.default_rng(k))[1]] for k in range(300)])
    assert values.min() >= 0.29 and values.max() <= 0.41


def test_correlations_of_older_models_are_read_from_their_fit() -> None:
    matrix = [[1.0, 0.5], [0.5, 1.0]]
    model = replace(small_model(), fit=FitFile(stages={"phys-geo": {"correlation": matrix}}))
    (block,) = with_correlations(model).correlations
    assert block.parameters == ("friction", "damping_ratio") and block.matrix == ((1.0, 0.5), (0.5, 1.0))
    newer = replace(model, file=correlated_file())
    assert with_correlations(newer) == newer.file


def test_what_follows_from_the_draws_follows() -> None:
    derived = tuple(
        FittedParameter(name=name, unit="1", estimate=1.0, std_error=0.1, state="derived")
        for name in ("restitution", "stiffness_n_m", "damping_n_s_m")
    )
    file = small_model().file
    file = file.model_copy(update={"parameters": (*file.parameters, *derived)})
    drawn, entries = draw_parameters(file, 1.0, np.random.default_rng(1), {"cube.mass_kg": Distribution(fixed=0.5)})
    value = {entry.name: entry.value for entry in entries}
    assert drawn.contact is not None and drawn.bodies[0].mass_kg == 0.5 == value["cube.mass_kg"]
    assert value["stiffness_n_m"] == pytest.approx(0.5 / drawn.contact.contact_time_s**2)
    assert value["damping_n_s_m"] == pytest.approx(2 * value["damping_ratio"] * 0.5 / drawn.contact.contact_time_s)
    assert 0 < value["restitution"] < 1


def test_a_plan_replaces_parameters() -> None:
    effect = EffectModel(name="linear_drag", parameters={"c": 0.1})
    file = small_model().file.model_copy(update={"effects": (effect,)})
    replaced = {"linear_drag.c": Distribution(uniform=(0.2, 0.3)), "contact_time_s": Distribution(fixed=0.01)}
    require_admissible(file, replaced)
    drawn, entries = draw_parameters(file, 1.0, np.random.default_rng(0), replaced)
    assert 0.2 <= drawn.effects[0].parameters["c"] <= 0.3
    assert drawn.contact is not None and drawn.contact.contact_time_s == 0.01
    added = {entry.name: entry for entry in entries[3:]}
    assert added["linear_drag.c"].unit == "1/s" and added["linear_drag.c"].estimate == 0.1
    assert added["contact_time_s"].unit == "s" and added["contact_time_s"].value == 0.01


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("frictoin", 0.3, r"no parameter of this model[\s\S]*Did you mean 'friction'"),
        ("friction", [0.1, 3.0], r"friction reaches from 0.1 to 3[\s\S]*Allowed: 0.01 to 2 1"),
        ("cube.mass_kg", {"normal": [0.1, 0.1]}, r"cube.mass_kg reaches -0.2: Input should be greater than"),
        ("linear_drag.c", [-1, 1], r"linear_drag.c reaches from -1 to 1"),
    ],
)
def test_inadmissible_parameters_are_refused(name: str, given: object, message: str) -> None:
    effect = EffectModel(name="linear_drag", parameters={"c": 0.1})
    file = small_model().file.model_copy(update={"effects": (effect,)})
    with pytest.raises(InputDataError, match=message):
        require_admissible(file, {name: Distribution.model_validate(given)})


def test_a_factor_of_a_moment_stretches_the_inertia_that_was_fitted() -> None:
    entry = FittedParameter(name="cube.moment_x", unit="1", estimate=2.0, std_error=0.2, bounds=(0.1, 10.0))
    file = small_model().file.model_copy(update={"parameters": (entry,)})
    assert with_parameter(file, "cube.moment_x", 2.0).bodies == file.bodies
    xx, yy, zz, *_ = with_parameter(file, "cube.moment_x", 3.0).bodies[0].inertia_kg_m2
    half = 0.5 * file.bodies[0].inertia_kg_m2[0]  # of a cube, each second moment
    np.testing.assert_allclose([xx, yy, zz], [2 * half, 2.5 * half, 2.5 * half])


def test_starts_as_the_plan_says() -> None:
    model = small_model()
    for seed in range(10):
        rng = np.random.default_rng(seed)
        plan = resolve_plan(model, SamplingPlan(start="slide", heading_deg=Distribution(uniform=(80, 100))))
        start = draw_start(model, plan, 1.0, rng)
        velocity, turn = start.velocity_m_s[0], rotation_matrix(start.quat_wxyz[0])
        assert velocity[1] > 0 and abs(velocity[2]) < 1e-12
        assert abs(np.degrees(np.arctan2(velocity[1], velocity[0])) - 90) <= 10
        np.testing.assert_allclose(turn @ UP, UP, atol=1e-12)  # upright, and spins about the vertical
        np.testing.assert_allclose((turn @ start.omega_body_rad_s[0])[:2], 0, atol=1e-12)
        lowest = (np.asarray(model.collision["cube"].means) @ turn.T + start.position_m[0])[:, 2].min()
        assert lowest - 0.1 * HALF == pytest.approx(0, abs=1e-12)
        upright = resolve_plan(model, SamplingPlan(orientation="upright"))
        thrown = draw_start(model, upright, 1.0, rng)
        np.testing.assert_allclose(rotation_matrix(thrown.quat_wxyz[0]) @ UP, UP, atol=1e-12)
        assert thrown.position_m[0, 2] > HALF
        photo = draw_start(model, resolve_plan(model, SamplingPlan(orientation="photo")), 1.0, rng)
        np.testing.assert_array_equal(photo.quat_wxyz[0], [1, 0, 0, 0])
    with pytest.raises(InputDataError, match="has no ground"):
        bare = replace(model, file=model.file.model_copy(update={"ground": None}))
        resolve_plan(bare, SamplingPlan(start="slide"))


@pytest.mark.parametrize("curvature", [0.0, 3.0, -3.0])
def test_a_pusher_passes_the_object_on_an_arc(curvature: float) -> None:
    aim, heading, left = np.array([0.1, 0.2, 0.03]), np.array([1.0, 0, 0]), np.array([0.0, 1, 0])
    track = push_track(aim, np.array([1.0, 0, 0, 0]), heading, left, 0.3, 0.5, curvature, 0.4, 2.0)
    assert track.velocity_m_s is not None
    reached = [np.interp(0.3 / 0.5, track.time_s, track.position_m[:, k]) for k in range(3)]
    np.testing.assert_allclose(reached, aim, atol=1e-4)
    steps = np.linalg.norm(np.diff(track.position_m, axis=0), axis=1)
    assert steps.sum() == pytest.approx(0.4, rel=1e-4)  # stops after its length
    assert track.time_s[-1] == pytest.approx(0.8) and (track.velocity_m_s[-1] == 0).all()
    np.testing.assert_allclose(np.linalg.norm(track.velocity_m_s[:-1], axis=1), 0.5)
    if curvature:
        radii = np.linalg.norm(track.position_m - (aim + left / curvature), axis=1)
        np.testing.assert_allclose(radii, 1 / 3, atol=1e-12)
        assert len(track.time_s) > 40


def test_the_pusher_follows_the_object_to_where_it_rests() -> None:
    """A body may rest where the photos show the pusher, which comes at it from wherever it rests."""
    model = small_model(driven=True)
    plan = resolve_plan(model, SamplingPlan.model_validate({"offset_m": 0.3, "push_miss": 0.0, "push_gap_m": 0.01}))
    radii = [extent(model, body).radius_m for body in model.file.bodies]
    places = []
    for seed in range(30):
        start = draw_start(model, plan, 1.0, np.random.default_rng(seed))
        apart = np.linalg.norm(start.position_m[0, :2] - start.position_m[1, :2])
        assert apart == pytest.approx(sum(radii) + 0.01)
        places.append(start.position_m[0, :2])
    assert 0.2 < np.linalg.norm(places, axis=1).max() <= 0.3
    assert np.linalg.norm(np.array(places) - [0.2, 0], axis=1).min() < sum(radii)


def test_pushes_are_their_actions(tmp_path: Path) -> None:
    path = write_small_model(tmp_path / "model", driven=True)
    plan = SamplingPlan.model_validate(
        {"push_speed_m_s": 0.5, "push_curve_1_m": 4.0, "push_heading_deg": 90, "push_length_m": 0.06}
    )
    config = CONFIG.model_copy(update={"plan": plan, "rollouts": 1, "duration_s": 0.4})
    summary = synthesize(path, tmp_path / "out", config)
    reader = RolloutReader(tmp_path / "out" / summary.shard)
    position, command, time = (reader.read(0, key) for key in ("bodies/pos", "actions", "time"))
    moving = time < 0.06 / 0.5
    np.testing.assert_allclose(np.linalg.norm(command[moving], axis=1), 1)
    assert (command[~moving] == 0).all() and not moving.all()
    np.testing.assert_array_equal(position[~moving, 1], position[[-1] * int((~moving).sum()), 1])
    travelled = np.diff(position[moving, 1], axis=0)
    np.testing.assert_allclose(travelled, 0.5 * command[moving][:-1] / 30, atol=9e-4)  # the chord of the arc
    reader.close()


def test_cameras_vary_by_rollout_and_look_at_the_bodies() -> None:
    model = small_model()
    varied = SamplingPlan.model_validate(
        {
            "view_elevation_deg": [20, 60],
            "view_distance_m": [0.5, 1.5],
            "view_shift_deg": [-30, 30],
            "view_roll_deg": 10,
        }
    )
    plan = resolve_plan(model, varied)
    cameras = look_at_cameras(model, plan, CONFIG)
    seen = []
    for index in range(20):
        drawn = draw_rollout(model, plan, CONFIG, cameras, 0.2, index)
        again = draw_rollout(model, plan, CONFIG, cameras, 0.2, index)
        for number, (name, camera) in enumerate(drawn.cameras.items()):
            np.testing.assert_array_equal(camera.T_world_cam, again.cameras[name].T_world_cam)
            way = camera.T_world_cam[:3, 2]
            target = camera.center + way * (0.5 * (plan.height_m.support[1] + 2 * 0.0825) - camera.center[2]) / way[2]  # pyright: ignore
            distance = np.linalg.norm(target - camera.center)
            elevation = np.degrees(np.arcsin(-way[2]))
            azimuth = np.degrees(np.arctan2(camera.center[0], -camera.center[1]))
            seen.append((distance, elevation, azimuth - (-50, 50)[number]))
            np.testing.assert_allclose(camera.T_world_cam[:3, :3].T @ camera.T_world_cam[:3, :3], np.eye(3), atol=1e-12)
            # rolled by 10 degrees: the image's x axis leaves the level by that
            assert np.degrees(
                np.arcsin(abs(camera.T_world_cam[2, 0]) / np.cos(np.radians(elevation)))
            ) == pytest.approx(10)
    values = np.array(seen)
    for column, (low, high) in enumerate(((0.5, 1.5), (20, 60), (-30, 30))):
        slack = 0.02 * (high - low)  # the height of the target is that of the extent, to 1 mm
        assert low - slack <= values[:, column].min() < low + 0.2 * (high - low)
        assert high - 0.2 * (high - low) < values[:, column].max() <= high + slack
    still = resolve_plan(model, SamplingPlan())
    shared = look_at_cameras(model, still, CONFIG)
    assert draw_rollout(model, still, CONFIG, shared, 0.2, 3).cameras is shared


def test_exposures_are_in_the_pictures_and_in_the_labels(tmp_path: Path) -> None:
    path = write_small_model(tmp_path / "model")
    bright = SamplingPlan.model_validate(
        {"light_gain": [0.5, 0.9], "exposure_gain": [0.8, 1.2], "exposure_tint": [0.9, 1.1], "exposure_offset": 0.05}
    )
    for name, plan in (("plain", SamplingPlan()), ("bright", bright)):
        synthesize(path, tmp_path / name, CONFIG.model_copy(update={"plan": plan, "rollouts": 2}))
    plain, seen = RolloutReader(tmp_path / "plain"), RolloutReader(tmp_path / "bright")
    gains = []
    for rollout in range(2):
        for camera in ("view0", "view1"):
            gain, offset = (seen.read(rollout, f"cameras/{camera}/{key}") for key in ("gain_rgb", "offset_rgb"))
            before = plain.read(rollout, f"obs/{camera}_image").astype(float)
            after = seen.read(rollout, f"obs/{camera}_image")
            np.testing.assert_allclose(after, (before * gain + 255 * offset).clip(0, 255), atol=0.501)
            np.testing.assert_array_equal(
                plain.read(rollout, f"obs/{camera}_mask"), seen.read(rollout, f"obs/{camera}_mask")
            )
            np.testing.assert_array_equal(plain.read(rollout, f"cameras/{camera}/gain_rgb"), 1)
            light = seen.read(rollout, "light/gain_rgb")
            assert (0.8 * 0.9 * light <= gain).all() and (gain <= 1.2 * 1.1 * light).all()
            gains.append(tuple(gain))
    assert len(set(gains)) == 4
    plain.close()
    seen.close()


def test_the_lamp_turns_about_the_vertical() -> None:
    file = small_model().file.model_copy(update={"light": Light(lamp=(0.5, 0.0, 0.3), sky=0.1)})
    plan = SamplingPlan.model_validate({"light_turn_deg": 90})
    lighting = draw_lighting(file, UP, plan, ["view0"], np.random.default_rng(0))
    assert lighting.light is not None and lighting.light.sky == 0.1
    np.testing.assert_allclose(lighting.light.lamp, [0, 0.5, 0.3], atol=1e-12)


def labels_of(speed: float = 0.0, depth: float = 0.0, impulse: float = 1.0) -> RolloutLabels:
    """A cube that slides towards the cameras for a second, with one contact on the ground."""
    time = np.linspace(0, 1, 5)
    position = np.stack([0 * time, -speed * time, HALF + 0 * time], -1)[:, None]
    zeros = np.zeros((5, 1, 3))
    velocity = zeros + np.array([0, -speed, 0])
    table = ContactTable(
        offsets=np.array([0, 0, 1, 1, 1, 1]),
        body_a=np.array([0]),
        body_b=np.array([-1]),
        position_m=np.zeros((1, 3)),
        normal=UP[None],
        distance_m=np.array([-depth]),
        impulse_n_s=impulse * UP[None],
        sliding=np.zeros(1, np.uint8),
    )
    plan = resolve_plan(small_model(), SamplingPlan())
    return RolloutLabels(
        episode_index=0,
        seed=0,
        model_mjcf="",
        time_s=time,
        states=np.zeros((5, 1)),
        actions=np.zeros((5, 1)),
        action_meaning="",
        bodies=("cube",),
        motions=("free",),
        mass_kg=np.array([MASS]),
        com_m=zeros[0],
        inertia_kg_m2=np.ones((1, 6)),
        position_m=position,
        quat_wxyz=np.tile([1.0, 0, 0, 0], (5, 1, 1)),
        velocity_m_s=velocity,
        omega_body_rad_s=zeros,
        gravity_m_s2=-9.81 * UP,
        contacts=table,
        contact_force_n=zeros,
        contact_torque_n_m=zeros,
        cameras=look_at_cameras(small_model(), plan, CONFIG),
    )


@pytest.mark.parametrize(
    ("rules", "broken", "kept"),
    [
        ({"off_table_m": 0.5}, labels_of(speed=0.51), labels_of(speed=0.49)),
        ({"no_contact": True}, labels_of(impulse=0.0), labels_of()),
        ({"penetration_m": 0.002}, labels_of(depth=0.0021), labels_of(depth=0.0019)),
        ({"unrest_m_s": 0.1}, labels_of(speed=0.11), labels_of(speed=0.09)),
        ({"unseen_share": 0.5}, labels_of(speed=5.0), labels_of(speed=0.1)),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_each_rule_rejects(rules: dict[str, float], broken: RolloutLabels, kept: RolloutLabels) -> None:
    rejection = Rejection.of(small_model(), RejectionRules.model_validate(rules))
    assert rejection.reason(broken) == next(iter(rules))
    assert rejection.reason(kept) is None
    assert Rejection.of(small_model(), RejectionRules()).reason(broken) is None


def test_a_push_has_to_meet_the_object() -> None:
    model = small_model(driven=True)
    rejection = Rejection.of(model, RejectionRules(no_contact=True))
    one = labels_of()
    pose = {name: np.repeat(getattr(one, name), 2, axis=1) for name in ("position_m", "quat_wxyz", "velocity_m_s")}
    both = replace(one, bodies=("cube", "tip"), motions=("free", "driven"), **pose)  # pyright: ignore[reportArgumentType]
    assert rejection.reason(both) == "no_contact"  # the ground alone does not count
    assert rejection.reason(replace(both, contacts=replace(one.contacts, body_b=np.array([1])))) is None


def test_what_is_rejected_is_drawn_again_in_batches_of_any_size() -> None:
    def reason(labels: RolloutLabels) -> str | None:
        return "off_table_m" if labels.seed % 3 else None  # the seed stands for the draw

    def number(index: int, attempt: int) -> int:
        return 7 * index + attempt

    def simulate(draws: Sequence[int]) -> list[RolloutLabels]:
        return [replace(labels_of(), seed=one) for one in draws]

    def run(batches: list[list[int]]) -> tuple[list[int], Counter[str]]:
        rejected, kept = Counter[str](), []
        for batch in batches:
            for drawn, labels in accepted_rollouts(batch, number, simulate, reason, 5, rejected):
                assert labels.seed == drawn
                kept.append(drawn)
        return kept, rejected

    whole, count = run([[0, 1, 2, 3]])
    assert whole == [0, 9, 15, 21] and count == {"off_table_m": 3}
    assert run([[0], [1], [2, 3]]) == (whole, count)


def test_rejection_is_counted_and_independent_of_the_sharding(tmp_path: Path) -> None:
    path = write_small_model(tmp_path / "model", visible=False)
    plan = SamplingPlan.model_validate(
        {"height_m": [0.0, 0.3], "vertical_speed_m_s": 0.0, "reject": {"no_contact": True}}
    )
    config = CONFIG.model_copy(update={"rollouts": 6, "plan": plan, "duration_s": 0.15})
    whole = synthesize(path, tmp_path / "whole", config)
    assert whole.rejected["no_contact"] > 0
    assert read_manifest(tmp_path / "whole").shards[0].rejected == whole.rejected
    parts = [
        synthesize(path, tmp_path / "parts", config.model_copy(update={"shards": 2, "shard": shard}))
        for shard in (1, 0)
    ]
    assert sum(part.rejected.get("no_contact", 0) for part in parts) == whole.rejected["no_contact"]
    one, two = RolloutReader(tmp_path / "whole"), RolloutReader(tmp_path / "parts")
    attempts = []
    for number in range(6):
        assert dict(one.group(number).attrs) == dict(two.group(number).attrs)
        np.testing.assert_array_equal(one.read(number, "states"), two.read(number, "states"))
        assert len(one.read(number, "contacts/body_a")) > 0
        attempts.append(int(one.group(number).attrs["attempt"]))
    assert sum(attempts) == whole.rejected["no_contact"]
    one.close()
    two.close()


def test_a_plan_that_nothing_passes_stops_and_leaves_nothing(tmp_path: Path) -> None:
    path = write_small_model(tmp_path / "model", visible=False)
    rules = {"no_contact": True, "off_table_m": 1e-6, "attempts": 7}
    plan = SamplingPlan.model_validate({"height_m": 5.0, "reject": rules})
    with pytest.raises(
        NotConvergedError,
        match=r"rejected all 7 draws for rollout 0: off_table_m 7.\nNext: slow the starts down.*under \[reject\]",
    ):
        synthesize(path, tmp_path / "out", CONFIG.model_copy(update={"plan": plan}))
    assert [entry.name for entry in tmp_path.iterdir()] == ["model"]


def test_the_resolved_plan_makes_the_same_dataset(tmp_path: Path) -> None:
    path = write_small_model(tmp_path / "model", visible=False)
    plan = SamplingPlan.model_validate(tomllib.loads(plan_toml(resolved_plan(path, SamplingPlan()))))
    assert plan.start == "throw" and plan.height_m is not None
    hashes = {
        synthesize(path, tmp_path / name, CONFIG.model_copy(update={"plan": chosen})).sha256
        for name, chosen in (("default", SamplingPlan()), ("resolved", plan))
    }
    assert len(hashes) == 1
    with h5py.File(next((tmp_path / "default").glob("*.h5"))) as file:
        written = json.loads(file.attrs["config_json"])["plan"]
    assert SamplingPlan.model_validate(written) == plan
    assert extent(small_model(), small_model().file.bodies[0]).radius_m * 3 == pytest.approx(plan.height_m.support[1])


def test_what_a_plan_asks_of_a_model_that_lacks_it_is_told(tmp_path: Path) -> None:
    path = write_small_model(tmp_path / "model", visible=False)
    unseen = SamplingPlan.model_validate({"reject": {"unseen_share": 0.0}})
    with pytest.raises(InputDataError, match="no visual spheres, so that no camera sees it, and the plan has unseen"):
        synthesize(path, tmp_path / "out", CONFIG.model_copy(update={"plan": unseen}))
    turned = SamplingPlan.model_validate({"light_turn_deg": [0, 90]})
    notes = synthesize(path, tmp_path / "out", CONFIG.model_copy(update={"plan": turned, "rollouts": 1})).notes
    assert "light_turn_deg turns nothing: the model has no light" in notes
    assert "drawn each by itself, because the model has no correlations of them: friction, damping_ratio" in notes


def test_shards_of_one_plan_belong_together(tmp_path: Path) -> None:
    path = write_small_model(tmp_path / "model", visible=False)
    kinds = {"height_m": {"normal": [0.2, 0.01]}, "heading_deg": {"choice": [0, 90]}, "spin_rad_s": 0}
    kinds |= {"parameters": {"friction": [0.2, 0.3]}}
    plan = SamplingPlan.model_validate(kinds)
    config = CONFIG.model_copy(update={"plan": plan, "shards": 2, "rollouts": 2})
    for shard in (0, 1):
        synthesize(path, tmp_path / "out", config.model_copy(update={"shard": shard}))
    assert len(read_manifest(tmp_path / "out").shards) == 2
    reader = RolloutReader(tmp_path / "out")
    for number in (0, 1):
        assert 0.2 <= reader.parameters(number)["friction"] <= 0.3
        velocity = reader.read(number, "bodies/vel")[0, 0]
        assert min(abs(velocity[:2])) < 1e-12  # along x or y, with no spin about another point than the middle
    reader.close()
