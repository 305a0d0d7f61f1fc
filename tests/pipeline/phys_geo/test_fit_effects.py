"""Effects in a fit: added by name, fitted with the rest, kept in the model, and used wherever the model is."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets import Track
from cgwm.datasets.capture.tracks import write_tracks
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.fit import fit
from cgwm.pipeline.optimization import uncertainty
from cgwm.pipeline.optimization.importance_sampling import SearchResult
from cgwm.pipeline.phys_geo.effects.by_motion import fit_effect_flights
from cgwm.pipeline.phys_geo.effects.effect_fit import fit_effects
from cgwm.pipeline.phys_geo.effects.requested_effects import fit_with_effects, fitted_effects, with_effects
from cgwm.pipeline.phys_geo.tracks import contact_shooting, open_loop_search
from cgwm.pipeline.physics import ContactLaw, World, world_of_model
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.engine import rollout as roll_out
from cgwm.pipeline.physics.observation_model import measure
from cgwm.pipeline.physics.parameters import CONTACT_PARAMETERS, effect_parameters
from cgwm.pipeline.segments import first_contact_fit
from cgwm.schemas import EffectModel, FittedParameter, InputDataError, PhysConfig, UsageError
from helpers.small_model import write_small_model
from helpers.worlds import F64, ball_body, box_body, state_of, times, world_of

BRIEF = PhysConfig(generations=4, population=24, iterations=1)


def boxes(ground: bool = True) -> World:
    """A box, in steps that are long enough for the tests to be short."""
    return world_of(box_body(), ground=ground, step_s=0.002)


def thrown(world: World, count: int, noise_m: float = 5e-4) -> list[tuple[str, dict[str, Track]]]:
    """Tracks of boxes that the world threw, with noise of the positions."""
    generator = torch.Generator().manual_seed(0)
    episodes = []
    for item in range(count):
        quat = torch.randn(4, generator=generator, dtype=F64)
        start = state_of(((0, 0, 0.4), tuple(quat.tolist()), (3.0, 0.5 * item - 1, 0.5), (3.0, -2.0, 1.0)))
        rollout = roll_out(world, start, times(0.5, 60.0))
        position = rollout.position_m[0, :, 0]
        position = position + noise_m * torch.randn(position.shape, generator=generator, dtype=F64)
        track = Track(rollout.times_s.numpy(), position.numpy(), rollout.quat_wxyz[0, :, 0].numpy())
        episodes.append((str(item), {"box": track}))
    return episodes


def active(name: str, **values: float) -> ActiveEffect:
    return ActiveEffect.of(load_effect(name), values)


def test_drag_is_found_with_the_contact_and_lowers_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contact_shooting, "SHOT_ITERATIONS", 1)  # the search and the first contacts tell
    episodes = thrown(replace(boxes(), effects=(active("quadratic_drag", k=0.2),)), 4)
    plain = fit_with_effects(boxes(), episodes, BRIEF, (5e-4, 1e-3))
    world = replace(boxes(), effects=(active("quadratic_drag"),))
    found = fit_with_effects(world, episodes, BRIEF, (5e-4, 1e-3))
    drag = next(p for p in found.parameters if p.name == "quadratic_drag.k")
    assert drag.interval_95 is not None and drag.interval_95[0] < 0.2 < drag.interval_95[1]
    assert drag.estimate == pytest.approx(0.2, rel=0.25) and drag.unit == "1/m"
    assert [block.parameters for block in found.correlations][1] == ("quadratic_drag.k",)
    assert found.record.to_json()["search_open_loop_m"][-1] < 0.75 * plain.record.to_json()["search_open_loop_m"][-1]


# In the suite: constants on their grid are tried in the same way by a diagnosis, test_diagnosis.py.
@pytest.mark.evidence
def test_constants_are_tried_on_their_grid_and_the_best_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(first_contact_fit, "ITERATIONS", 1)
    monkeypatch.setattr(contact_shooting, "SHOT_ITERATIONS", 1)
    effect = load_effect("ground_magnet")
    (constant,) = effect.constants
    truth = {effect.parameters[0].name: 6.0, constant.name: constant.grid[-1]}
    episodes = thrown(replace(boxes(), effects=(active("ground_magnet", **truth),)), 1)
    brief = BRIEF.model_copy(update={"generations": 2, "population": 8, "iterations": 1})
    world = replace(boxes(), effects=(active("ground_magnet"),))
    found = fit_with_effects(world, episodes, brief, (5e-4, 1e-3))
    tried = found.record.to_json()["effects"]["constants_tried"]
    assert [row[f"ground_magnet.{constant.name}"] for row in tried] == list(constant.grid)
    best = min(tried, key=lambda row: row["cost"])
    assert found.constants == {f"ground_magnet.{constant.name}": best[f"ground_magnet.{constant.name}"]}


def test_an_effect_that_lacks_what_it_needs_is_refused() -> None:
    episodes = thrown(boxes(ground=False), 1)
    world = replace(boxes(ground=False), effects=(active("ground_magnet"),))
    with pytest.raises(InputDataError, match="'ground_magnet' needs a ground in the manifest, and this capture has"):
        fit_with_effects(world, episodes, BRIEF, (None, None))


def test_effects_join_those_of_the_parent_and_take_their_fitted_values() -> None:
    present = (EffectModel(name="linear_drag", parameters={"c": 0.1}),)
    joined = with_effects(present, ["quadratic_drag", "linear_drag", "quadratic_drag"])
    assert [effect.name for effect in joined] == ["linear_drag", "quadratic_drag"]
    found = [
        FittedParameter(name="quadratic_drag.k", unit="1/m", estimate=0.3),
        FittedParameter(name="friction", unit="1", estimate=0.2),
    ]
    names = {effect.name: effect.name for effect in joined}
    fitted = fitted_effects(joined, names, found, {})
    assert [effect.parameters for effect in fitted] == [{"c": 0.1}, {"k": 0.3}]


def test_a_models_effects_act_in_its_world_and_a_wrong_parameter_is_refused(tmp_path: Path) -> None:
    path = write_small_model(tmp_path / "model")
    model = read_model(path)
    dragged = model.file.model_copy(update={"effects": (EffectModel(name="linear_drag", parameters={"c": 2.0}),)})
    worlds = [world_of_model(replace(model, file=file)) for file in (model.file, dragged)]
    start = state_of(
        *[((0, 0, 5.0 * k + 5), (1, 0, 0, 0), (1.0, 0, 0), (0, 0, 0)) for k in range(len(worlds[0].bodies))]
    )
    free = worlds[0].free[0]
    ends = [float(roll_out(world, start, times(0.2)).velocity_m_s[0, -1, free, 0]) for world in worlds]
    assert ends == [pytest.approx(1.0), pytest.approx(np.exp(-0.4), rel=1e-2)]
    wrong = model.file.model_copy(update={"effects": (EffectModel(name="linear_drag", parameters={"k": 2.0}),)})
    with pytest.raises(InputDataError, match="linear_drag has no k; it has c"):
        world_of_model(replace(model, file=wrong))


def test_a_measurement_effect_changes_what_is_seen_and_not_what_happens() -> None:
    world = replace(boxes(), effects=(active("length_scale", s=0.02),))
    start = state_of(((0.5, 0, 1.0), (1, 0, 0, 0), (1.0, 0, 0), (0, 0, 0)))
    true, seen = roll_out(world, start, times(0.3)), measure(world, start, times(0.3))
    torch.testing.assert_close(seen.position_m, 1.02 * true.position_m, atol=1e-12, rtol=0)
    torch.testing.assert_close(seen.velocity_m_s, true.velocity_m_s, atol=0, rtol=0)


def test_a_users_effect_is_named_by_its_whole_path_and_names_may_not_meet(tmp_path: Path) -> None:
    source = (
        'from cgwm.pipeline.physics.effects.linear_drag import LinearDrag\nclass Mine(LinearDrag):\n    name = "{}"\n'
    )
    (tmp_path / "mine.py").write_text(source.format("mine"))
    (effect,) = with_effects((), [f"{tmp_path}/../{tmp_path.name}/mine.py:Mine"])
    assert effect.name == f"{tmp_path}/mine.py:Mine"
    assert with_effects([effect], [f"{tmp_path}/mine.py:Mine"]) == (effect,)
    (tmp_path / "other.py").write_text(source.format("linear_drag"))
    with pytest.raises(UsageError, match=r"two effects are called 'linear_drag': linear_drag and .*other.py:Mine"):
        with_effects((), ["linear_drag", f"{tmp_path}/other.py:Mine"])


def test_what_a_fit_cannot_find_is_refused(tmp_path: Path) -> None:
    episodes = thrown(boxes(), 1)
    driven = replace(ball_body(name="tip"), motion="driven")
    world = replace(world_of(box_body(), driven), effects=(active("length_scale"),))
    with pytest.raises(InputDataError, match="'length_scale' with a driven body: the body's track is its command"):
        fit_with_effects(world, episodes, BRIEF, (5e-4, 1e-3))
    with pytest.raises(InputDataError, match=r"phys-geo.step_s is 5 ms(.|\n)*up to 3.1 ms"):
        fit_with_effects(boxes(), episodes, BRIEF.model_copy(update={"step_s": 0.005}), (5e-4, 1e-3))
    model = read_model(write_small_model(tmp_path / "model"))
    for name, values, found in (
        ("linear_drag", {"c": -5.0}, "linear_drag.c is -5 1/s"),
        ("gone.py:Mine", {}, "gone.py"),
    ):
        file = model.file.model_copy(update={"effects": (EffectModel(name=name, parameters=values),)})
        with pytest.raises(InputDataError, match=rf"model/model\.json: .*{found}"):
            world_of_model(replace(model, file=file))


def test_up_is_against_gravity_on_a_slope_too() -> None:
    world = replace(boxes(), effects=(active("buoyancy", b=1.0),))
    slope = torch.tensor([0.6, 0.0, 0.8], dtype=F64)
    start = state_of(((0, 0, 5.0), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0)))
    rollout = roll_out(replace(world, ground_normal=slope), start, times(0.1))
    assert rollout.velocity_m_s[0, -1, 0].tolist() == pytest.approx([0, 0, -0.881], abs=1e-9)


def test_a_fit_that_was_begun_starts_at_the_worlds_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contact_shooting, "SHOT_ITERATIONS", 1)
    law = ContactLaw(*(torch.tensor([value], dtype=F64) for value in (0.12, 0.02, 5.0)))
    world = replace(boxes(), contact=law)
    seen: list[tuple[list[float], int]] = []
    search = open_loop_search.importance_search

    def noted(*arguments: Any, **more: Any) -> SearchResult:
        seen.append((more["first"].tolist(), more["generations"]))
        return search(*arguments, **more)

    monkeypatch.setattr(open_loop_search, "importance_search", noted)
    episodes = thrown(boxes(), 1)
    for begun in (True, False):
        fit_with_effects(world, episodes, BRIEF, (5e-4, 1e-3), begun)
    friction, contact_time, damping = CONTACT_PARAMETERS
    assert seen[0][0] == [friction.encode(0.12), contact_time.encode(0.02), damping.encode(damping.bounds[1])]
    assert seen[1][0] == [p.encode(p.prior[0]) for p in CONTACT_PARAMETERS]
    assert [generations for _, generations in seen] == [2, 4]


# In the suite: what a child takes from its parent is tested in test_earlier_estimates.py.
@pytest.mark.evidence
def test_a_child_has_its_own_warnings_and_not_its_parents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The parent's fit of the physics is gone, and so is what it warned of; what its photos showed is still true."""
    monkeypatch.setattr(contact_shooting, "SHOT_ITERATIONS", 1)
    root = tmp_path / "capture"
    (root / "tracks").mkdir(parents=True)
    text = ['format = "cgwm-capture/1"', "[world]", "ground = { normal = [0.0, 0.0, 1.0], offset_m = 0.0 }"]
    text += ['[[bodies]]\nname = "box"\nmass_kg = 1.0', "shape = { sphere = { radius_m = 0.05 } }"]
    text += ['[splits]\ntrain = ["0"]']
    (root / "capture.toml").write_text("\n".join(text) + "\n")
    write_tracks(root / "tracks" / "0.csv", thrown(boxes(), 1)[0][1])
    brief = BRIEF.model_copy(update={"generations": 2, "population": 8, "iterations": 1, "step_s": 0.003})
    fit(root, tmp_path / "m0", stage="phys-geo", phys_config=brief)
    path = tmp_path / "m0" / "model.json"
    parent = json.loads(path.read_text())
    record = json.loads((tmp_path / "m0" / "fit.json").read_text())["stages"]["phys-geo"]
    assert record["warnings"] and set(record["warnings"]) <= set(parent["warnings"])
    gone, kept = "the parent's contact time ended on its bound", "a photo is blurred"
    record_path = tmp_path / "m0" / "fit.json"
    changed = json.loads(record_path.read_text())
    changed["stages"]["phys-geo"]["warnings"] = [gone]
    record_path.write_text(json.dumps(changed))
    path.write_text(json.dumps(parent | {"warnings": [gone, kept]}))
    child = fit(root, tmp_path / "m1", stage="phys-geo", parent=tmp_path / "m0", phys_config=brief)
    assert kept in child.warnings and gone not in child.warnings
    assert len(set(child.warnings)) == len(child.warnings)


def test_effects_of_flight_are_found_in_flights_from_nothing() -> None:
    truth = {"quadratic_drag": {"k": 0.4}, "wind": {"w_x": -1.5, "w_y": 2.0}}
    hidden = tuple(active(name, **values) for name, values in truth.items())
    episodes = thrown(replace(boxes(), effects=hidden), 4)
    world = replace(boxes(), effects=tuple(active(name) for name in truth))
    found = fit_effects(world, episodes, [], (5e-4, 1e-3))
    assert found.record["flights"] >= 4 and "windows" not in found.record
    for parameter in found.parameters:
        name, _, number = parameter.name.partition(".")
        assert parameter.interval_95 is not None
        assert parameter.interval_95[0] < truth[name][number] < parameter.interval_95[1]
    estimate = {p.name: p.estimate for p in found.parameters}
    assert estimate["quadratic_drag.k"] > 0.1 and estimate["wind.w_x"] < -0.5 and estimate["wind.w_y"] > 0.5


# In the suite: each of the two is found alone in this file.
@pytest.mark.evidence
def test_what_flights_show_stands_beside_effects_of_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(first_contact_fit, "ITERATIONS", 2)
    episodes = thrown(replace(boxes(), effects=(active("spin_damping", d=1.0),)), 3)
    alone, beside = (
        fit_effects(replace(boxes(), effects=effects), episodes, [], (5e-4, 1e-3))
        for effects in (
            (active("spin_damping"),),
            (active("viscous_friction"), active("spin_damping")),
        )
    )
    assert beside.record["windows"] == 3 and beside.record["in_flight"]["flights"] >= 3
    assert [p.name for p in beside.parameters] == ["spin_damping.d", "viscous_friction.c_v"]
    assert beside.parameters[0] == alone.parameters[0]


def test_flights_that_do_not_show_an_effect_give_nothing_of_it() -> None:
    """Without orientations nothing tells of a spin, and a drag is found all the same."""
    episodes = [(name, {"box": replace(t["box"], quat_wxyz=None)}) for name, t in thrown(boxes(), 3)]
    both = replace(boxes(), effects=(active("spin_damping"), active("linear_drag")))
    told = fit_effect_flights(both, episodes, [(p, 0.5) for p in effect_parameters(both)], (5e-4, 1e-3))
    assert told is not None and [p.name for p in told.parameters] == ["linear_drag.c"]
    world = replace(boxes(), effects=(active("spin_damping"),))
    wanted = [(parameter, 0.5) for parameter in effect_parameters(world)]
    assert fit_effect_flights(world, episodes, wanted, (5e-4, 1e-3)) is None


def test_what_carries_no_information_has_a_wide_interval() -> None:
    """Neither nan nor nothing, where rounding leaves less than no information, or where there is none at all."""
    one, other = np.array([1.0, 1.0]) / np.sqrt(2), np.array([1.0, -1.0]) / np.sqrt(2)
    turned = 4.0 * np.outer(one, one) - 1e-13 * np.outer(other, other)
    for information, known in ((turned, one), (np.diag([4.0, 0.0]), np.array([1.0, 0.0]))):
        covariance = uncertainty.few_covariance(information, np.zeros((3, 2)))
        assert np.isfinite(covariance).all() and (np.diag(covariance) > 0).all()
        assert known @ covariance @ known == pytest.approx(0.25, rel=1e-3)
        assert np.sqrt(np.diag(covariance).max()) > 1e4


def test_few_of_many_episodes_that_tell_a_number_are_few() -> None:
    """Eight alike are eight; where one tells nine tenths of a number, its interval is that of two episodes."""
    alike = np.tile(np.eye(1), (8, 1, 1))
    assert uncertainty.student_reach(alike, np.eye(1) / 8) == pytest.approx(1.0)
    one = np.array([0.9, *[0.1 / 7] * 7])[:, None, None]
    reach = uncertainty.student_reach(one, np.eye(1))
    assert reach == pytest.approx(uncertainty.student_quantile(0.975, 1) / uncertainty.student_quantile(0.975, 7))
    assert (uncertainty.student_reach(0 * alike, np.eye(1)) >= 1.0).all()


def test_few_episodes_make_intervals_wider_where_they_scatter_and_never_narrower() -> None:
    information = np.diag([100.0, 4.0])
    alike, apart = np.zeros((3, 2)), np.array([[30.0, 0.0], [-30.0, 0.0], [0.0, 0.0]])
    assert np.allclose(uncertainty.few_covariance(information, alike), np.diag([0.01, 0.25]))
    # 2 * 30^2 / 100^2 of scatter, times 3 / 2 and (4.303 / 1.96)^2
    wide = uncertainty.few_covariance(information, apart)
    assert wide[0, 0] == pytest.approx(0.18 * 1.5 * (4.3027 / 1.96) ** 2, rel=1e-3) and wide[1, 1] == 0.25
    many = np.tile(apart, (3, 1))
    many_wide = uncertainty.few_covariance(information, many)[0, 0]
    assert many_wide == pytest.approx(6 * 900 / 1e4 * 9 / 8 * (2.3060 / 1.96) ** 2, rel=1e-3)
