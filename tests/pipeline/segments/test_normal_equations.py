"""Linear algebra of segments, episodes and groups against the same problems written out whole."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.physics.parameters import Parameter
from cgwm.pipeline.segments.candidates import Variant
from cgwm.pipeline.segments.flights import variance_components
from cgwm.pipeline.segments.flights.repeated_forces import PRIOR_STD, _frames, _held_out, _is_better, _on_path
from cgwm.pipeline.segments.flights.restricted_likelihood import Scored
from cgwm.pipeline.segments.flights.variance_components import LONGEST, _climb
from cgwm.pipeline.segments.held_out_gain import FOLDS, ContactLinearization
from cgwm.pipeline.segments.linearization import Linearization, _fits, _linearization, eliminate, layout, sums, widths
from cgwm.pipeline.segments.mixed_model import _factors, _solved
from cgwm.pipeline.segments.release_detection import _rotation_chi2, without_held
from cgwm.pipeline.trajectories.correlated_noise import WindowErrors
from cgwm.pipeline.trajectories.innovations import FALLS, CorrelatedNoise
from cgwm.pipeline.trajectories.observations import Observations

EPISODE = np.array([0, 0, 1, 2, 2, 3])
GROUP = np.array([0, 0, 0, 1, 1, 1])
ORDERS = list(FALLS)


def parameter(shared: Any, width: float) -> Parameter:
    return Parameter(
        name=f"{shared}{width}",
        unit="1",
        bounds=(-1.0, 1.0),
        logarithmic=False,
        reveals="",
        prior=(0.0, width),
        shared=shared,
    )


PARAMETERS = (parameter("all", 2.0), parameter("group", 3.0), parameter("episode", 0.5), parameter("all", 4.0))


def linearization(seed: int = 0) -> Linearization:
    """Six segments of four episodes in two sessions, four parameters."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(6, 9, 4))
    return Linearization(
        parameters=PARAMETERS,
        base=1,
        information=rows.swapaxes(1, 2) @ rows,
        score=rng.normal(size=(6, 4)),
        weight=rng.uniform(0.2, 1.0, 6),
        episode=EPISODE,
        group=GROUP,
        prior=np.array([7.0, 0.0, 0.0, 0.0]),
        chi2=rng.uniform(1, 9, 6),
        dof=np.full(6, 9.0),
    )


def test_values_of_sessions_and_episodes_stand_side_by_side() -> None:
    one = linearization()
    places, prior = layout(one, [2, 0, 1])
    assert places[:, 0].tolist() == EPISODE.tolist()
    assert places[:, 1].tolist() == [4] * 6
    assert places[:, 2].tolist() == [5, 5, 5, 6, 6, 6]
    assert prior.tolist() == [1 / 0.25] * 4 + [7.0] + [1 / 9.0] * 2
    assert widths(one, [2, 0, 1]).tolist() == [0.5] * 4 + [2.0] + [3.0] * 2


def test_sums_are_those_of_the_design_that_is_written_out() -> None:
    one = linearization()
    places, prior = layout(one, [1, 2, 3])
    information, score = np.diag(prior), np.zeros(len(prior))
    for k in range(6):
        design = np.zeros((3, len(prior)))
        design[np.arange(3), places[k]] = 1.0
        information += one.weight[k] * design.T @ one.information[k][1:, 1:] @ design
        score += one.weight[k] * design.T @ one.score[k][1:]
    found = sums(one, [1, 2, 3])
    np.testing.assert_allclose(found[0], information)
    np.testing.assert_allclose(found[1], score)
    np.testing.assert_allclose(sums(one, [1, 2, 3], np.ones(7))[0], information + np.diag(1 - prior))
    left, right = eliminate(information, score, 2)
    np.testing.assert_allclose(np.linalg.inv(left), np.linalg.inv(information)[2:, 2:])
    np.testing.assert_allclose(np.linalg.solve(left, right), np.linalg.solve(information, score)[2:])
    assert eliminate(information, score, 0)[0] is information


def test_episodes_are_left_out_or_taken_alone_by_their_weights() -> None:
    one = linearization()
    assert one.without_episode(2).weight.tolist() == [*one.weight[:3], 0.0, 0.0, one.weight[5]]
    assert one.only_episode(2).weight.tolist() == [0.0, 0.0, 0.0, *one.weight[3:5], 0.0]
    assert one.columns([PARAMETERS[2].name, PARAMETERS[0].name]) == [2, 0]
    segments: Any = SimpleNamespace(items=[SimpleNamespace(episode=k) for k in (1, 0, 1)])
    ones = torch.ones(3, dtype=torch.float64)
    linear: Any = SimpleNamespace(
        weight=0.5 * ones, chi2=ones, dof=ones, information=torch.ones(3, 4, 4), score=torch.ones(3, 4)
    )
    for robust, weight in ((True, 0.5), (False, 1.0)):
        made = _linearization(linear, segments, PARAMETERS, 2, (5, 8), robust)
        assert made.weight.tolist() == [weight] * 3 and made.group.tolist() == [8, 5, 8]
        assert made.prior.tolist() == [1 / 4, 1 / 9, 0.0, 0.0] and made.episode.tolist() == [1, 0, 1]


def test_candidates_share_a_batch_up_to_its_size_and_one_candidate_of_a_type() -> None:
    def variant(name: str, place: int) -> Any:
        effect: Any = load_effect(name)
        return Variant(place, SimpleNamespace(effect=effect), {})  # pyright: ignore[reportArgumentType]

    drag, wind, other = variant("linear_drag", 0), variant("wind", 1), variant("linear_drag", 2)
    size = len(drag.parameters) + len(wind.parameters)
    assert _fits([drag], wind, size, True) and not _fits([drag], wind, size - 1, True)
    assert not _fits([drag], other, 9, True) and _fits([drag], other, 9, False)
    assert _fits([drag], variant("linear_drag", 0), 9, True)  # the same one with another constant
    assert _fits([], drag, len(drag.parameters), True)


def test_held_out_episodes_gain_what_the_others_step_explains() -> None:
    """Quadratic misfits: half the fall at the step of the other folds, with the priors about their centres."""
    rng = np.random.default_rng(2)
    count = 2 * FOLDS + 1
    rows = rng.normal(size=(count, 8, 3))
    information, score = rows.swapaxes(1, 2) @ rows, rng.normal(size=(count, 3))
    away, held = rng.normal(size=3), np.array([3.0, 2.0, 1.0])
    one = ContactLinearization(
        names=("a", "b", "c"), base=1, information=information, score=score, prior=(away, held), excess=1.7, misfit=9.0
    )

    def fall(chosen: list[int], item: int) -> float:
        others = [k for k in range(count) if k % FOLDS != item % FOLDS]
        normal = sum(information[k][np.ix_(chosen, chosen)] for k in others) / 1.7 + np.diag(held[chosen])
        slope = sum(score[k][chosen] for k in others) / 1.7 - held[chosen] * away[chosen]
        step = np.linalg.solve(normal, slope)
        own = information[item][np.ix_(chosen, chosen)]
        return float(score[item][chosen] @ step - 0.5 * step @ own @ step)

    for columns, over in (((2,), ()), ((1, 2), (1,))):
        wanted = [fall([0, *columns], k) - fall([0, *over], k) for k in range(count)]
        np.testing.assert_allclose(one.gain(columns, over).by_episode, wanted, rtol=1e-9)


def test_a_posterior_is_the_mean_of_data_and_prior_by_their_information() -> None:
    matrix, mean, tau = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([1.0, -2.0]), np.array([0.5, 2.0])
    values, covariance = _solved(matrix, np.array([3.0, 1.0]), mean, tau)
    prior = np.diag([4.0, 0.25])
    np.testing.assert_allclose(covariance, np.linalg.inv(matrix + prior))
    np.testing.assert_allclose((matrix + prior) @ values, np.array([3.0, 1.0]) + prior @ mean)


def test_errors_of_items_are_those_that_their_kind_leaves_at_the_best_values() -> None:
    """One value, items of known information: a fixed point of factor = chi2 / degrees at the weighted mean."""
    count, kind = np.array([40.0, 40.0, 60.0, 60.0]), np.array([0, 0, 1, 1])
    precision, truth = np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.1, -0.2, 0.3, 0.2])
    size = np.array([2.0, 2.0, 5.0, 5.0])  # of the error variance
    errors = WindowErrors(
        chi2=size * count + precision * truth**2, count=count, kind=kind, inflation=np.array([1.0, 1.0])
    )
    centre, width, at = np.zeros(1), np.full(1, 10.0), np.zeros(1)
    found = _factors(precision[:, None, None], (precision * truth)[:, None], at, errors, centre, width)
    best = (precision / found) @ truth / ((precision / found).sum() + 0.01)
    lost = precision / found / ((precision / found).sum() + 0.01)
    chi2 = size * count + precision * (truth - best) ** 2
    free = count - lost
    for k in (0, 1):
        some = kind == k
        pooled = chi2[some].sum() / free[some].sum()
        np.testing.assert_allclose(found[some], np.maximum(pooled, chi2[some] / free[some]), rtol=1e-6)
    assert found[:2] == pytest.approx(2.0, rel=0.05) and found[2:] == pytest.approx(5.0, rel=0.05)


def test_rotations_have_two_orientations_less_than_were_measured() -> None:
    rows = torch.full((3, 5, 6), 2.0, dtype=torch.float64)
    rows[0, 1, 4] = torch.inf
    turned = torch.ones(3, 5, 1, dtype=torch.float64)
    turned[1, 2:] = 0
    flight: Any = SimpleNamespace(
        residuals=lambda *_, jacobian: (rows, jacobian),
        world=SimpleNamespace(gravity=torch.zeros(1, 3, dtype=torch.float64)),
        observations=SimpleNamespace(has_orientation=turned),
    )
    found = _rotation_chi2(flight)
    assert found[0] == pytest.approx(14 * 4.0 / (3 * 3)) and torch.isnan(found[1])
    assert found[2] == pytest.approx(15 * 4.0 / (3 * 3))


def test_frames_before_a_release_count_as_not_measured() -> None:
    ones = torch.ones(2, 4, 1)

    whole = Observations(
        names=("a", "b"), times_s=ones[..., 0], position_m=ones, quat_wxyz=ones, seen=ones, has_orientation=ones,
        drives={}, state=SimpleNamespace(), free=(0,), measured_axes=ones,  # pyright: ignore[reportArgumentType]
    )  # fmt: skip
    found = without_held(whole, {1: 3})
    for marks in (found.seen, found.has_orientation):
        assert marks[..., 0].tolist() == [[1, 1, 1, 1], [0, 0, 0, 1]]
    assert bool(whole.seen.all())


def test_a_wrench_of_the_others_is_held_out_against_each_episode() -> None:
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(5, 8, 6))
    information, score = rows.swapaxes(1, 2) @ rows, rng.normal(size=(5, 6))
    groups, episodes = np.array([0, 1, 0, 1, 1]), np.array([4, 4, 7, 7, 9])
    wanted = []
    for episode in (4, 7, 9):
        gain = 0.0
        for k in np.flatnonzero(episodes == episode):
            others = [j for j in range(5) if episodes[j] != episode and groups[j] == groups[k]]
            matrix = np.eye(6) / PRIOR_STD**2 + sum(information[j] for j in others)
            wrench = np.linalg.solve(matrix, sum((score[j] for j in others), np.zeros(6)))
            gain += 2 * score[k] @ wrench - wrench @ information[k] @ wrench
        wanted.append(gain)
    assert _held_out(groups, episodes, score, information) == pytest.approx(wanted)


def test_axes_along_a_path_are_right_handed_and_keep_what_a_wrench_explains() -> None:
    along = np.array([[3.0, 0.0, 4.0], [0.0, 0.0, -2.0], [1.0, 2.0, 0.0]])
    axes = _frames(along)
    np.testing.assert_allclose(axes @ axes.swapaxes(1, 2), np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(axes[:, 0], along / np.linalg.norm(along, axis=1)[:, None])
    assert axes[:, 1, 2] == pytest.approx(0.0) and axes[1, 1].tolist() == [1.0, 0.0, 0.0]
    rng = np.random.default_rng(3)
    rows = rng.normal(size=(3, 8, 6))
    found: Any = SimpleNamespace(
        information=rows.swapaxes(1, 2) @ rows, wrench=rng.normal(size=(3, 6)), velocity=along, omega=along[::-1]
    )
    score, information = _on_path(found)
    turned = np.concatenate(
        [
            np.einsum("nij,nj->ni", axes, found.wrench[:, :3]),
            np.einsum("nij,nj->ni", axes[::-1], found.wrench[:, 3:]),
        ],
        1,
    )
    np.testing.assert_allclose(score, np.einsum("nij,nj->ni", information, turned))
    same = np.einsum("ni,nij,nj->n", found.wrench, found.information, found.wrench)
    np.testing.assert_allclose(np.einsum("ni,ni->n", score, turned), same)


def test_a_law_is_better_where_all_episodes_say_so() -> None:
    def law(*gains: float) -> Any:
        return SimpleNamespace(gains=gains)

    assert _is_better(law(5.0, 5.1, 4.9, 5.0), law(1.0, 1.0, 1.0, 1.0))
    assert not _is_better(law(1.0, 1.0, 1.0, 1.0), law(5.0, 5.1, 4.9, 5.0))
    assert not _is_better(law(90.0, 0.0, 1.0, -1.0), law(0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("best", [(0.3, -0.4), (0.3, 5.0), (-7.0, -0.4)])
def test_a_likelihood_is_climbed_to_its_top_within_bounds(best: tuple[float, float]) -> None:
    """A parabola with a slope that changes little by little: as one whose information is too large by half."""
    top, low, high = np.array(best), np.array([-2.0, -2.0]), np.array([2.0, 2.0])
    tried = []

    def scored(z: np.ndarray) -> Scored:
        tried.append(z)
        matrix = np.array([[900.0, 100.0], [100.0, 400.0]])
        return Scored(float(-0.5 * (z - top) @ matrix @ (z - top)), matrix @ (top - z), 1.5 * matrix)

    end, value = _climb(scored, np.array([[-1.5, 9.0]]), low, high)
    assert tried[0].tolist() == [-1.5, 2.0]
    assert np.abs(np.diff(tried[:2], axis=0)).max() <= LONGEST + 1e-12
    matrix = np.array([[900.0, 100.0], [100.0, 400.0]])
    slope = matrix @ (top - end)
    free = ((end > low) | (slope > 0)) & ((end < high) | (slope < 0))
    # the gain that is left is below what ends a climb
    assert np.abs(slope[free] / np.sqrt(np.diag(matrix)[free])).max(initial=0.0) < 0.3
    assert value == pytest.approx(-0.5 * (end - top) @ matrix @ (end - top))
    assert ((end >= low) & (end <= high)).all() and len(tried) < 20


def test_a_step_that_overshoots_is_damped_until_it_climbs() -> None:
    tried = []

    def scored(z: np.ndarray) -> Scored:
        tried.append(float(z[0]))
        return Scored(float(-10 * abs(z[0] - 1.0)), np.sign(1.0 - z) * 10, np.array([[12.0]]))

    end, value = _climb(scored, np.array([[0.0]]), np.array([-5.0]), np.array([5.0]))
    assert value == max(-10 * abs(one - 1.0) for one in tried) and abs(float(end[0]) - 1.0) < 0.35


def component_choice(
    monkeypatch: pytest.MonkeyPatch, gains: tuple[float, float, float], share: float, white: float = 100.0
) -> Any:
    """Return what is chosen of white and fast noise, a slow process and a sway with given gains, and the starts."""
    log: list[tuple[int, tuple[str, ...], float]] = []
    found = {
        (): CorrelatedNoise(share, 0.01, 1.0, order=0.5),
        ("slow",): CorrelatedNoise(share, 0.01, 1.0, slow=0.5, slow_time_s=0.2, order=0.5),
        ("sway",): CorrelatedNoise(share, 0.01, 1.0, sway=2.0, order=0.5),
        ("slow", "sway"): CorrelatedNoise(share, 0.01, 1.0, slow=0.5, slow_time_s=0.2, sway=2.0, order=0.5),
    }
    values = {(): 100.0, ("slow",): 100 + gains[0] / 2, ("sway",): 100 + gains[1] / 2}
    values["slow", "sway"] = 100 + gains[2] / 2

    def climbed(_: object, starts: Any, kinds: Any, order: float) -> tuple[CorrelatedNoise, float]:
        log.append((len(starts), tuple(kinds), order))
        return found[tuple(kinds)]._replace(order=order), values[tuple(kinds)] - (order != ORDERS[0]) * 5

    monkeypatch.setattr(variance_components, "_climbed", climbed)
    monkeypatch.setattr(variance_components, "_white", lambda _: white)
    contrasts: Any = SimpleNamespace(times_s=torch.tensor([[0.0, 0.3], [0.0, 0.5]], dtype=torch.float64))
    known = CorrelatedNoise(0.0, 0.01, 1.0)
    return variance_components.variance_components(contrasts, known, (0, 1)), log, known


@pytest.mark.parametrize("slow", [True, False])
@pytest.mark.parametrize("sway", [True, False])
def test_components_without_evidence_are_left_out(slow: bool, sway: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    least = variance_components.LIMITS
    first = least.evidence + (1.0 if slow else -1.0)
    second = least.sway_evidence + (1.0 if sway else -1.0)
    gains = (first, second, first + second)
    (best, still, gain, sway_gain), log, known = component_choice(monkeypatch, gains, 0.0)
    assert (best.slow > 0, best.sway > 0) == (slow, sway)
    assert gain == pytest.approx(first if slow else 0.0) and sway_gain == pytest.approx(second if sway else 0.0)
    assert still.sway == 0.0 and (still.slow > 0) == slow and (slow or still is known)
    if not slow and not sway:
        assert best is known
    kinds = [kind for _, kind, _ in log]
    assert kinds == [()] * len(ORDERS) + [("slow",), ("slow", "sway") if slow else ("sway",)]
    assert [order for _, _, order in log] == [*ORDERS, ORDERS[0], ORDERS[0]] and log[len(ORDERS)][0] >= 2


@pytest.mark.parametrize("shown", [True, False])
def test_a_fast_process_that_flights_alone_show_is_kept(shown: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    white = 100 - variance_components.LIMITS.evidence / 2 - (1.0 if shown else -1.0)
    (best, still, *_), _, known = component_choice(monkeypatch, (0.0, 0.0, 0.0), 0.6, white)
    assert best is still and (best.share == 0.6 if shown else best is known)


def test_layouts_do_not_depend_on_the_order_of_segments() -> None:
    one = linearization()
    order = np.array([3, 5, 0, 1, 4, 2])
    other = replace(
        one,
        information=one.information[order],
        score=one.score[order],
        weight=one.weight[order],
        episode=one.episode[order],
        group=one.group[order],
    )
    for mine, theirs in zip(sums(one, [0, 1, 2, 3]), sums(other, [0, 1, 2, 3]), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-12)
