"""What to measure next, a residual law as an effect of one's own, and diagnoses from poses found in videos."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from cgwm.cli.app import app
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.diagnose import diagnose, stage
from cgwm.pipeline.diagnose.contact.search import Chosen
from cgwm.pipeline.diagnose.evidence.evidence import Evidence
from cgwm.pipeline.diagnose.evidence.score_test import ScoreTest
from cgwm.pipeline.diagnose.law_export import law_source, save_law
from cgwm.pipeline.diagnose.next_experiment.experiments import (
    DEFAULT,
    Experiment,
    experiments_of,
    read_experiments,
    states_of,
)
from cgwm.pipeline.diagnose.next_experiment.throws import (
    RankedExperiment,
    Rivals,
    next_experiment,
    ranked_experiments,
    rivals_of,
)
from cgwm.pipeline.diagnose.verdict import Findings
from cgwm.pipeline.physics import State, World
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.effects.catalogue import new_effect
from cgwm.pipeline.physics.observation_model import measure
from cgwm.pipeline.physics.parameters import effect_parameters
from cgwm.pipeline.segments.candidates import Candidate
from cgwm.pipeline.segments.prepare import Prepared, prepare
from cgwm.pipeline.segments.segment_fit import refit
from cgwm.schemas import DiagnoseResult, InputDataError, LawTerm, ResidualLaw, UsageError
from helpers.diagnosis_data import NOISE, tosses, world_with, write_capture
from PIL import Image
from typer.testing import CliRunner

THROWS = experiments_of(DEFAULT)


@pytest.fixture(autouse=True)
def throws_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Motions for contact take seconds, and have tests of their own."""
    monkeypatch.setattr(stage, "next_motions", lambda *_: None)


def evidence(name: str, **numbers: float) -> Evidence:
    """An effect with its estimates, as a refit leaves it."""
    effect = load_effect(name)
    value = np.array([numbers.get(p.name, 0.0) for p in effect.parameters])
    test = ScoreTest(
        statistic=100.0, dof=len(value), p_value=1e-9, estimate=value, covariance=np.eye(len(value)), admissible=True
    )
    found = {p.name: (float(v), 0.1 * p.scale) for p, v in zip(effect.parameters, value, strict=True)}
    return Evidence(
        candidate=Candidate(name, effect), constants={}, test=test, p_value=1e-9, delta_bic=-50.0, numbers=found
    )


def findings(world: World, *equals: Evidence) -> Findings:
    return Findings(
        verdict="not_separable",
        chosen=(Chosen(equals[0], equals, "flight"),),
        remaining=False,
        flight=SimpleNamespace(),  # pyright: ignore[reportArgumentType]
        ranking=equals,
        contact=(),
        world=world,
        contact_chi2=1.0,
        base=world,
        errors={},
    )


def slow(world: World, seed: int = 1, count: int = 3) -> list[tuple[str, dict[str, Track]]]:
    """Slow tosses from low down, which show little of the air."""
    rng = np.random.default_rng(seed)
    chosen = [
        Experiment(
            on_ground=False,
            height_m=0.25,
            speed_m_s=float(v),
            elevation_deg=45.0,
            heading_deg=float(h),
            spin_rad_s=5.0,
            spin_axis="up",
            duration_s=0.3,
        )
        for v, h in zip(rng.uniform(0.4, 1.0, count), rng.uniform(0, 360, count), strict=True)
    ]
    return thrown(world, chosen, seed)


def thrown(world: World, throws: list[Experiment], seed: int) -> list[tuple[str, dict[str, Track]]]:
    """Throws, measured with noise at 100 Hz."""
    rng = np.random.default_rng(seed)
    zero = torch.zeros(1, 1, 3, dtype=torch.float64)
    quat = torch.tensor([[[1.0, 0, 0, 0]]], dtype=torch.float64)
    state = states_of(world, 0, throws, zero[0, 0], State(zero, quat, zero, zero))
    times = torch.arange(round(100 * throws[0].duration_s) + 1, dtype=torch.float64) / 100
    with torch.no_grad():
        motion = measure(world, state, times)
    position = motion.position_m[:, :, 0].numpy()
    position = position + NOISE[0] * rng.standard_normal(position.shape)
    name = world.bodies[0].name
    return [
        (f"{seed}-{k}", {name: Track(times.numpy(), position[k], motion.quat_wxyz[k, :, 0].numpy())})
        for k in range(len(throws))
    ]


def rival_drags(world: World, strength: float) -> Rivals:
    return Rivals((evidence("linear_drag", c=strength), evidence("quadratic_drag", k=0.8 * strength)), world)


def odds(prepared: Prepared, world: World) -> float:
    """The log-likelihood ratio of linear over quadratic drag, both refitted in flight."""
    costs = []
    for name in ("linear_drag", "quadratic_drag"):
        added = replace(world, effects=(ActiveEffect.of(load_effect(name)),))
        costs.append(refit([prepared.flight], added, effect_parameters(added)).cost)
    return 0.5 * (costs[1] - costs[0])


def test_a_fast_throw_tells_drags_apart_and_a_slow_drop_does_not() -> None:
    truth, world = world_with("ball", {"linear_drag": {"c": 0.3}}), world_with("ball")
    data = slow(truth)
    prepared = prepare(world, data, NOISE)
    ranked = ranked_experiments(prepared, rival_drags(world, 0.3), [t for t in THROWS if not t.on_ground], 1.0)
    words = [r.throw.what for r in ranked]
    assert words[0].startswith("throw it") and "fast" in words[0]
    assert ranked[0].throw.speed_m_s == 4.0 and ranked[0].throw.spin_rad_s == 0.0
    lowest = words.index("drop it without spin: 0.3 m high")
    assert lowest > len(words) // 2
    (pair,) = ranked[0].by_pair
    gains = [r.by_pair[pair] for r in ranked]
    assert gains[0] > 20 * gains[lowest] >= 0
    # what is promised is what measuring gives: top and bottom throw, added to the data
    before = odds(prepared, world)
    after = [odds(prepare(world, [*data, *thrown(truth, [r.throw], 9)], NOISE), world) for r in (ranked[0], ranked[-1])]
    assert after[0] - before > 3 * max(after[1] - before, 1.0)
    assert ranked[0].least[pair] / 3 < after[0] - before < 3 * ranked[0].by_pair[pair]


def test_the_next_experiment_names_the_throw_and_its_state() -> None:
    world = world_with("ball")
    prepared = prepare(world, slow(world_with("ball", {"linear_drag": {"c": 0.3}})), NOISE)
    drags = rival_drags(world, 0.3).evidence
    found = next_experiment(prepared, findings(world, *drags), THROWS[4:10])
    assert found is not None
    assert found.separates == ("linear_drag", "quadratic_drag") and not found.not_separated
    assert found.what == "throw it flat and fast without spin: 4.0 m/s, 0.4 m high"
    assert found.initial_state["velocity_m_s"] == [4.0, 0.0, 0.0]
    assert found.initial_state["position_m"][2] == pytest.approx(0.44)  # the ball's radius is 4 cm
    assert [entry["rank"] for entry in found.ranked] == list(range(1, 7))
    assert found.ranked[0]["order_of_magnitude"] in (10.0, 100.0, 1000.0)
    gains = [entry["expected_gain_nats"] for entry in found.ranked]
    assert found.expected_gain_nats == gains[0] > gains[-1]
    assert (
        next_experiment(prepared, replace(findings(world, *drags), verdict="none_missing", chosen=()), THROWS) is None
    )


def test_where_no_throw_helps_it_says_what_does() -> None:
    world = world_with("ball", ground=False)
    prepared = prepare(world, tosses(world_with("ball", {"com_offset": {"d_x": 0.004}}, False), 2, 3, 0.3), NOISE)
    equals = (evidence("com_offset", d_x=0.004), evidence("marker_offset", d_x=-0.004))
    found = next_experiment(prepared, findings(world, *equals), THROWS)
    assert found is not None
    assert found.what.startswith("no throw tells com_offset and marker_offset apart") and "balance" in found.what
    assert found.initial_state == {} and found.expected_gain_nats == 0.0
    assert found.not_separated == ("com_offset", "marker_offset")
    # nothing can be thrown
    found = next_experiment(prepared, findings(world, *equals), [])
    assert found is not None and found.what.startswith("com_offset: balance") and not found.ranked
    # a third rival can be told apart by a throw, these two still cannot
    found = next_experiment(prepared, findings(world, *equals, evidence("linear_drag", c=0.4)), THROWS)
    assert found is not None
    assert set(found.separates) == {"com_offset", "marker_offset", "linear_drag"}
    assert found.not_separated == ("com_offset", "marker_offset") and found.initial_state
    assert "no throw tells com_offset and marker_offset apart" in found.what


def test_rivals_are_equals_or_what_comes_close_behind() -> None:
    world = world_with("ball", {"linear_drag": {"c": 0.3}})
    first, second = evidence("linear_drag", c=0.3), evidence("quadratic_drag", k=0.2)
    alone = replace(findings(world, first), verdict="missing_effect")
    assert rivals_of(alone) is None
    near = rivals_of(replace(alone, ranking=(first, replace(second, delta_bic=-40.0))))
    assert near is not None and near.names == ("linear_drag", "quadratic_drag")
    assert near.world.effects == ()  # none of them
    assert rivals_of(replace(alone, ranking=(first, replace(second, delta_bic=-30.0)))) is None
    equals = rivals_of(findings(world, first, second))
    assert equals is not None and equals.names == near.names
    assert rivals_of(replace(findings(world, first, second), verdict="unexplained")) is None
    # without the drag nothing carries a wind
    windy = world_with("ball", {"linear_drag": {"c": 0.3}, "wind": {"w_x": 1.0}, "magnus_lift": {"s": 0.01}})
    beside = rivals_of(findings(windy, first, second))
    assert beside is not None and [one.effect.name for one in beside.world.effects] == ["magnus_lift"]


def test_the_command_says_what_to_throw_next(tmp_path: Path) -> None:
    truth = world_with("ball", {"gravity_tilt": {"tilt_x": 0.02}})
    root, throws = tmp_path / "capture", tmp_path / "throws.toml"
    model = write_capture(root, truth, tosses(truth, 3, 5, 0.35, height_m=(1.0, 1.4)), test=1)
    throws.write_text(
        "[[throws]]\nspeed_m_s = [2.0]\nheight_m = [2.5]\n[[throws]]\non_ground = true\nspeed_m_s = [1.0, 3.0]\n"
    )
    done = CliRunner().invoke(app, ["diagnose", str(model), str(root), "--throws", str(throws)])
    assert done.exit_code == 0, done.output
    # the measured frame is tilted, or gravity: where the ground is touched, its height tells
    assert "To distinguish gravity_tilt, frame_tilt and constant_force: let it slide over the ground" in done.stdout
    assert "no throw tells gravity_tilt and constant_force apart: gravity_tilt: put a spirit level" in done.stdout
    assert "  2. let it slide over the ground" in done.stdout


def test_the_gain_is_that_of_the_pair_that_is_separated_least() -> None:
    one = RankedExperiment(THROWS[0], {}, {("a", "b"): 5.0, ("a", "c"): 2.0}, {("a", "b"): 1.0, ("a", "c"): 1.5})
    assert one.least_gain([("a", "b"), ("a", "c")]) == 1.0
    assert one.gain([("a", "b")]) == 5.0 and one.gain([("a", "b"), ("a", "c")]) == 2.0 and one.gain([]) == 0.0


def test_the_user_sets_the_throws_up(tmp_path: Path) -> None:
    file = tmp_path / "throws.toml"
    file.write_text("[[throws]]\nspeed_m_s = [0.0, 3.0]\nelevation_deg = [0.0, 60.0]\nheading_deg = [0.0, 90.0]\n")
    found = read_experiments(file)
    # a drop has neither elevation nor heading
    assert [t.what for t in found] == [
        "drop it without spin: 0.4 m high",
        "throw it flat and fast without spin: 3.0 m/s, 0.4 m high",
        "throw it flat and fast without spin: 3.0 m/s, 0.4 m high, heading 90 deg",
        "throw it up at 60 deg and fast without spin: 3.0 m/s, 0.4 m high",
        "throw it up at 60 deg and fast without spin: 3.0 m/s, 0.4 m high, heading 90 deg",
    ]
    assert len(THROWS) == 30 == len({t.what for t in THROWS})
    file.write_text("[[throws]]\nspeed = [1.0]\n")
    with pytest.raises(InputDataError, match="unknown field 'speed'"):
        read_experiments(file)
    file.write_text(f"[[throws]]\nspeed_m_s = {list(range(401))}\n")
    with pytest.raises(InputDataError, match="401 throws"):
        read_experiments(file)


LAW = ResidualLaw(
    terms=(
        LawTerm(term="-u", coefficient=0.6, std_error=0.02, unit="1/s"),
        LawTerm(term="omega x u", coefficient=-0.04, std_error=0.001, unit="1"),
        LawTerm(term="z", coefficient=0.3, std_error=0.02, unit="m/s2"),
        LawTerm(term="-|omega| omega", coefficient=0.05, std_error=0.001, unit="1/rad"),
    ),
    exponent={"-u": (1.5, 1.25, 1.75), "-|omega| omega": (2.0, 1.75, 2.25)},
    left_chi2=1.0,
    where="speed",
)


def unexplained(law: ResidualLaw | None, selected: tuple[str, ...] = ()) -> DiagnoseResult:
    return DiagnoseResult(verdict="unexplained", sentence="So it is.", selected=selected, residual_law=law, episodes=3)


def test_a_law_becomes_an_effect_that_pulls_as_it_says(tmp_path: Path) -> None:
    path = tmp_path / "my_law.py"
    spec = save_law(unexplained(LAW), path)
    assert spec == f"{path}:ResidualLaw" and len(path.read_text().splitlines()) < 50
    effect = load_effect(spec)
    assert effect.name == "my_law" and effect.needs == ("spin",)
    assert [p.nonnegative for p in effect.parameters] == [True, False, False, True]
    assert [p.unit for p in effect.parameters] == ["m^-0.5 s^-0.5", "1", "m/s2", "1/rad"]
    values = {f"c{k + 1}": torch.tensor([t.coefficient], dtype=torch.float64) for k, t in enumerate(LAW.terms)}
    u, omega = (torch.tensor([v], dtype=torch.float64) for v in ([2.0, 0.0, -1.0], [0.0, 3.0, 4.0]))
    mass, inertia = torch.tensor([0.5], dtype=torch.float64), torch.diag(torch.tensor([1.0, 2.0, 3.0])).double()[None]
    motion = type("Motion", (), {"velocity": u, "omega": omega, "mass": mass, "inertia": inertia})()
    wrench = effect.wrench(values, motion)
    size = 5**0.25  # |u|^0.5
    lift = torch.linalg.cross(omega, u)
    force = 0.5 * (-0.6 * size * u - 0.04 * lift + torch.tensor([[0, 0, 0.3]]))
    assert wrench.force[0].tolist() == pytest.approx(force[0].tolist())
    assert wrench.torque[0].tolist() == pytest.approx([0.0, -0.05 * 5 * 3 * 2, -0.05 * 5 * 4 * 3])
    # the same law saved again keeps the file; another one does not take its place unasked
    written = path.stat().st_mtime_ns
    assert save_law(unexplained(LAW), path) == spec and path.stat().st_mtime_ns == written
    other = unexplained(LAW.model_copy(update={"terms": LAW.terms[:1]}))
    with pytest.raises(UsageError, match="exists"):
        save_law(other, path)
    assert save_law(other, path, overwrite=True) == spec and path.stat().st_mtime_ns != written
    with pytest.raises(UsageError, match="Python file"):
        save_law(unexplained(LAW), tmp_path / "law.txt")
    with pytest.raises(InputDataError, match=r"no residual law.* So it is"):
        save_law(unexplained(None), tmp_path / "none.py")
    assert not (tmp_path / "none.py").exists()
    # what a selected effect has is not had twice
    beside = unexplained(LAW.model_copy(update={"terms": LAW.terms[:2]}), ("linear_drag",))
    assert [p.unit for p in load_effect(save_law(beside, tmp_path / "beside.py")).parameters] == ["1"]
    there = unexplained(LAW)
    both = load_effect(save_law(there, tmp_path / "both.py")).parameters
    assert len(load_effect(save_law(there, tmp_path / "there.py", present=("linear_drag",))).parameters) < len(both)
    with pytest.raises(InputDataError, match="none of the known terms"):
        save_law(beside.model_copy(update={"selected": ("linear_drag", "magnus_lift")}), tmp_path / "none.py")
    assert 'name = "residual_law"' in law_source(LAW, tmp_path / "wind.py")


STRANGER = """from cgwm.pipeline.physics.effects import Effect, EffectParameter, Wrench, length


class Stranger(Effect):
    name = "stranger"
    summary = formula = reveals = source = "spin slowed by its square: no built-in effect"
    parameters = (EffectParameter("c", "1/rad", scale=0.1, limit=10.0),)
    phase = "flight"

    def wrench(self, values, motion):
        alpha = -values["c"][:, None] * length(motion.omega) * motion.omega
        return Wrench(torque=(motion.inertia @ alpha[..., None]).squeeze(-1))
"""


# In the suite: a law as an effect is tested above, that no file is replaced in test_outputs.py.
@pytest.mark.evidence
def test_a_law_found_is_saved_and_fitted(tmp_path: Path) -> None:
    file = tmp_path / "hidden.py"
    file.write_text(STRANGER)
    truth = world_with("ball")
    truth = replace(truth, effects=(ActiveEffect.of(load_effect(f"{file}:Stranger"), {"c": 0.2}),))
    root, law, fitted = tmp_path / "capture", tmp_path / "my_law.py", tmp_path / "m1"
    # high up, where nothing touches
    model = write_capture(root, truth, tosses(truth, 3, 4, 0.3, 60.0, height_m=(1.2, 1.6)), test=1)
    run = CliRunner().invoke
    done = run(app, ["diagnose", str(model), str(root), "--save-law", str(law), "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["saved_law"] == f"{law}:ResidualLaw"
    assert "-|omega| omega" in [term["term"] for term in found["residual_law"]["terms"]]
    law.write_text(law.read_text() + "# my own words\n")
    again = run(app, ["diagnose", str(model), str(root), "--save-law", str(law)])
    assert again.exit_code == 2 and "exists" in again.stderr and "my own words" in law.read_text()
    fit = ["fit", str(root), "--from", str(model), "--out", str(fitted), "--effects", found["saved_law"]]
    done = run(
        app,
        [
            *fit,
            "--quiet",
            "--set",
            "phys-geo.population=8",
            "--set",
            "phys-geo.generations=2",
            "--set",
            "phys-geo.step_s=0.003",
        ],
    )
    assert done.exit_code == 0, done.output
    (effect,) = read_model(fitted).file.effects
    saved = Path(found["saved_law"].partition(":")[0])
    assert effect.name == f"{fitted / 'effects' / saved.name}:ResidualLaw"
    assert (fitted / "effects" / saved.name).read_bytes() == saved.read_bytes()
    numbers = {p.name: p for p in read_model(fitted).file.parameters}
    assert numbers["my_law.c1"].estimate == pytest.approx(0.2, rel=0.1)


def filmed(root: Path, model: Path, std: float = 1e-3) -> None:
    """Take the tracks out of the capture's training split and put them where a fit from videos keeps its poses."""
    (model / "pose_tracks").mkdir()
    for name in ("000", "001", "002", "003"):
        shutil.move(root / "tracks" / f"{name}.csv", model / "pose_tracks" / f"{name}.csv")
        (root / "videos" / "left" / name).mkdir(parents=True)
        for k in range(2):
            Image.new("RGB", (8, 8)).save(root / "videos" / "left" / name / f"{k:06d}.png")
    fit = json.loads((model / "fit.json").read_text())
    records = {f"{k:03d}": {"position_std_m": std, "rotation_std_rad": 10 * std} for k in range(4)}
    fit["stages"] = {"phys-geo": {"pose_tracks": records}}
    (model / "fit.json").write_text(json.dumps(fit))


def test_poses_found_in_videos_serve_as_tracks(tmp_path: Path) -> None:
    truth = world_with("ball", {"magnus_lift": {"s": 0.04}})
    root = tmp_path / "capture"
    model = write_capture(root, truth, tosses(truth, 3, 5, 0.4, 60.0, (1e-3, 1e-2), (1.2, 1.6)), test=1)
    measured = diagnose(model, root)
    filmed(root, model)
    found = diagnose(model, root)
    assert found.selected == measured.selected == ("magnus_lift",)
    assert found.noise == {"position_m": pytest.approx(1e-3), "rotation_rad": pytest.approx(1e-2)}
    assert any("found in the videos" in warning for warning in found.warnings)
    assert not any("found in the videos" in warning for warning in measured.warnings)
    shutil.rmtree(model / "pose_tracks")
    with pytest.raises(InputDataError, match="no poses found in these videos") as error:
        diagnose(model, root)
    assert "--supervise images" in str(error.value)


# In the suite: an effect of one's own is loaded and simulated in test_effect_registry.py.
@pytest.mark.evidence
def test_an_effect_of_ones_own_is_tested_like_a_built_in_one(tmp_path: Path) -> None:
    file = tmp_path / "my_effect.py"
    new_effect(file)
    spec = f"{file}:MyEffect"
    truth = world_with("ball")
    truth = replace(truth, effects=(ActiveEffect.of(load_effect(spec), {"w": 4.0}),))
    root = tmp_path / "capture"
    model = write_capture(root, truth, tosses(truth, 3, 5, 0.4, 60.0, height_m=(1.2, 1.6)), test=1)
    with_it = diagnose(model, root, candidates=[spec])
    assert with_it.selected == (spec,) and with_it.verdict == "missing_effect"
    best = with_it.ranking[0]
    assert best.effect == spec and best.judged_in == "flight" and best.constants["r"] in (0.1, 0.2, 0.5)
    (number,) = best.parameters
    assert abs(number.estimate - 4.0) < 4 * number.std_error
