"""The benchmark of real-like captures: how answers are scored, what is carried, and that the generator stands alone."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.synthetic.hidden_effects import EFFECTS

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from real_like.engines import GROUPS
from real_like.errors import Errors, draw_errors, noise
from real_like.invented import BOUNDED, DEVELOPMENT, STRANGE, UNSEEN
from real_like.plan import STAGES, real_cases
from real_like.restitution import ball, has_fall
from real_like.score import judge, wilson

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def truth(*names: str, carried: tuple[str, ...] = (), unknown: bool = False) -> dict[str, object]:
    effects = [{"name": name, "ratio": 10.0, "comes_with": [], "unknown": unknown} for name in names]
    return {"effects": effects, "errors": {"carried": list(carried)}, "engine": {"comes_with": []}}


@pytest.mark.parametrize(
    ("hidden", "named", "aliases", "mark"),
    [
        (("wind",), ["wind"], [], "right"),
        (("wind",), ["linear_drag"], [["linear_drag", "wind"]], "right"),
        (("wind",), ["linear_drag"], [["linear_drag", "wind", "adhesion"]], "among"),
        (("wind",), ["linear_drag"], [], "wrong"),
        (("wind",), ["wind", "adhesion"], [], "right, and more"),
        (("wind", "adhesion"), ["wind"], [], "part"),
        (("wind",), [], [], "silent"),
        ((), [], [], "right"),
        ((), ["wind"], [], "wrong"),
    ],
)
def test_a_name_is_right_alone_or_in_its_class_and_nothing_wrong_beside(
    hidden: tuple[str, ...], named: list[str], aliases: list[list[str]], mark: str
) -> None:
    assert judge(truth(*hidden), {"named": named, "aliases": aliases})["mark"] == mark


def test_what_tracks_carry_may_be_named_and_only_as_what_it_is() -> None:
    tilted = truth(carried=("slow", "tilt"))
    assert judge(tilted, {"named": ["gravity_tilt@episode"]})["mark"] == "right"
    assert judge(tilted, {"named": ["gravity_tilt"]})["mark"] == "wrong"
    assert judge(truth(), {"named": ["gravity_tilt@episode"]})["mark"] == "wrong"
    assert judge(truth(carried=("scale",)), {"named": ["length_scale@group"]})["mark"] == "right"


def test_an_effect_in_no_library_is_right_when_said_to_be_unexplained() -> None:
    gust = truth("gust", unknown=True)
    assert judge(gust, {"named": [], "unexplained": True})["mark"] == "right"
    assert judge(gust, {"named": ["wind"], "unexplained": True})["mark"] == "wrong"
    assert judge(gust, None)["mark"] == "silent"


def test_the_interval_of_a_rate_is_wilsons() -> None:
    # Brown, Cai & DasGupta 2001: 0 of 200 gives z^2 / (n + z^2) as the upper end
    assert wilson(0, 200) == pytest.approx((0.0, 3.8415 / 203.8415), abs=1e-5)
    assert wilson(50, 100) == pytest.approx((0.4038, 0.5962), abs=1e-4)


def test_slow_errors_have_the_size_and_the_correlation_that_the_truth_says() -> None:
    given = Errors(white_m=0.0, white_rad=0.0, slow_m=1e-3, slow_rad=1e-2, slow_s=0.02, slow_kind="ou")
    times, rng = np.arange(400) / 100, np.random.default_rng(0)
    drawn = np.stack([noise(given, times, rng)[0] for _ in range(40)])
    assert drawn.std() == pytest.approx(1e-3, rel=0.05)
    correlation = (drawn[:, 2:] * drawn[:, :-2]).mean() / drawn.var()
    assert correlation == pytest.approx(np.exp(-1), abs=0.05)


def test_every_capture_carries_something_beside_the_slow_error_and_never_both_levels() -> None:
    for seed in range(200):
        carried = draw_errors(np.random.default_rng(seed), 100.0).carried()
        assert carried[0] == "slow" and 2 <= len(carried) <= 5
        assert not {"tilt", "height"} <= set(carried)


def test_seeds_of_development_and_reports_are_apart_and_do_not_depend_on_the_numbers() -> None:
    seeds = {stage: {case.name: case.seed for case in real_cases(stage, 12, 12, 12)} for stage in STAGES}
    assert all(seed % 2 == (stage != "development") for stage, own in seeds.items() for seed in own.values())
    few = {case.name: case.seed for case in real_cases("report1", 3, 6, 5)}
    assert few.items() <= seeds["report1"].items()


def test_reports_hide_laws_that_no_development_capture_has() -> None:
    stages = ("development", "report9", "report11")
    laws = {stage: {case.effects[0] for case in real_cases(stage, 0, 0, 60)} for stage in stages}
    assert laws["development"] == {*DEVELOPMENT, *BOUNDED} and laws["report9"] == set(UNSEEN)
    assert laws["report11"] == {*UNSEEN, *STRANGE} and not laws["development"] & laws["report11"]
    assert all(
        case.row == "unknown" and EFFECTS[case.effects[0]].acts == "unknown" for case in real_cases("report9", 0, 0, 9)
    )


def test_the_generator_does_not_load_what_judges() -> None:
    code = "import sys, real_like.record; print([m for m in sys.modules if m.startswith('cgwm.pipeline')])"
    done = subprocess.run([sys.executable, "-c", code], cwd=BENCHMARKS, capture_output=True, text=True, check=True,
                          env={"PYTHONPATH": ":".join([str(BENCHMARKS), *sys.path])})  # fmt: skip
    assert done.stdout.strip() == "[]"


@pytest.mark.evidence
def test_a_box_turns_in_rapiers_flight_as_its_moments_say() -> None:
    """Without torques the angular momentum of a box is constant: its colliders must not change its moments."""
    pytest.importorskip("rapier3d")
    from cgwm.datasets.synthetic.hidden_effects.mechanics import Mechanics, Start
    from real_like.engines import rapier_engine
    from scipy.spatial.transform import Rotation

    case = next(one for one in real_cases("development", 40, 0) if one.group == "rapier" and one.thing == "cube")
    thing = case.body_case().drawn_thing()
    spin = np.array([3.0, -6.0, 9.0])
    start = Start(np.array([0.0, 0, 9]), np.array([0.8, 0.2, -0.4, 0.4]), np.zeros(3), spin)
    world = Mechanics.of(thing, 1)
    motion = rapier_engine.simulate(world, [], start, 0.5)
    turn = Rotation.from_quat(motion.quat_wxyz, scalar_first=True)
    omega = (turn[:-1].inv() * turn[1:]).as_rotvec() / rapier_engine.STEP_S
    middle = turn[:-1] * Rotation.from_rotvec(0.5 * omega * rapier_engine.STEP_S)
    momentum = middle.apply(omega @ world.inertia_kg_m2.T)
    assert np.linalg.norm(momentum - momentum[0], axis=1).max() < 3e-3 * np.linalg.norm(momentum[0])


@pytest.mark.evidence
def test_the_size_of_a_wind_is_what_it_adds_to_its_drag() -> None:
    from cgwm.datasets.synthetic.hidden_effects import EFFECTS, mujoco_engine
    from cgwm.datasets.synthetic.hidden_effects.mechanics import Mechanics
    from cgwm.datasets.synthetic.hidden_effects.protocol import draw_start
    from real_like.sizes import Bench, sized_effect

    case = next(one for one in real_cases("development", 0, 90) if "wind" in one.effects and one.engine == "mujoco")
    thing = case.body_case().drawn_thing()
    starts = [("throw", draw_start(thing, "throw", case.rng(f"start {k}"))) for k in range(3)]
    bench = Bench(
        thing=thing, world=Mechanics.of(thing, 1), simulate=mujoco_engine.simulate, episodes=starts, length_s=0.6,
        errors=draw_errors(case.rng("errors"), 100.0), turned=False,
    )  # fmt: skip
    found = sized_effect("wind", bench, [5])
    assert found.ratio == pytest.approx(found.drawn_ratio, rel=0.2)
    assert found.size > 10e-3 * EFFECTS["wind"].large[thing.kind]


def test_throws_from_which_a_fit_may_choose_are_a_row_of_their_own() -> None:
    cases = real_cases("development", 0, 0, 0, 30)
    assert all(case.row == "tossed" and case.body_case().protocol == "throws" for case in cases)
    assert all(case.body_case().train == 14 and not case.body_case().centroid_only for case in cases)
    hidden = {EFFECTS[case.effects[0]].acts if case.effects else None for case in cases}
    assert hidden == {None, "flight", "measurement"}


@pytest.mark.parametrize(("group", "falls"), [("mujoco_hard", False), ("mujoco_graded", False)])
def test_an_engine_brings_a_restitution_by_speed_only_where_its_rebounds_fall_with_it(group: str, falls: bool) -> None:
    assert has_fall(group, ball()) == falls == ("velocity_restitution" in GROUPS[group][0].facts(ball())["comes_with"])
