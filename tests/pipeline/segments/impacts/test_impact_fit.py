"""Impact fit: model errors are pushes at the touching point; slopes, weights and priors are those of the sum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.pipeline.geometry.rotation import quat_exp, quat_to_matrix
from cgwm.pipeline.physics.impulse_solver import tangent_axes
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.segments.candidates import base_values
from cgwm.pipeline.segments.impact_law import after_impact, contact_law, point_velocity, rebound_speed
from cgwm.pipeline.segments.impacts.fit import (
    BASE,
    FRICTION_SHARE,
    IMPULSE_SHARE,
    REBOUND_SHARE,
    SPIN_SHARE,
    ImpactBase,
    ImpactProblem,
    fit_impacts,
    fits_to_weighted,
)
from cgwm.pipeline.segments.impacts.velocities import Impacts
from helpers.worlds import F64, ball_body, batch, world_of

RADIUS_M = 0.04


def tilted_world() -> World:
    """A ball whose mass is not in its middle, with an inertia of three values, over a ground that is not level."""
    turn = quat_to_matrix(quat_exp(torch.tensor([0.3, -0.5, 0.4], dtype=F64)))
    body = replace(
        ball_body(RADIUS_M, 0.2),
        inertia=(turn @ torch.diag(torch.tensor([1.0, 1.5, 2.2], dtype=F64)) @ turn.T)[None] * 1.3e-4,
        com=batch([0.004, -0.006, 0.003]),
    )
    normal = torch.tensor([0.2, -0.1, 1.0], dtype=F64)
    return replace(world_of(body), ground_normal=normal / normal.norm())


def impacts(count: int = 7) -> Impacts:
    rng = np.random.default_rng(0)
    before, after = rng.normal(size=(count, 6)), rng.normal(size=(count, 6))
    before[:, 2], after[:, 2] = -rng.uniform(1.5, 3, count), rng.uniform(1.0, 2.0, count)
    before[:, :2] *= 4  # some slide all the time
    before[:, 3:] *= 10
    after[:, 3:] = before[:, 3:] + 8 * after[:, 3:]
    own = rng.normal(size=(2, count, 6, 6))
    cover = 1e-4 * (own @ own.swapaxes(-1, -2) + np.eye(6))
    scale = np.repeat([1.0, 10.0], 3)
    cover = cover * scale[:, None] * scale
    return Impacts(
        episode=np.arange(count) // 2,
        place=torch.as_tensor(rng.normal(size=(count, 3))),
        rotation=quat_to_matrix(quat_exp(torch.as_tensor(rng.normal(size=(count, 3))))),
        before=torch.as_tensor(before),
        after=torch.as_tensor(after),
        covariance_before=torch.as_tensor(cover[0]),
        covariance_after=torch.as_tensor(cover[1]),
    )


def usual() -> torch.Tensor:
    return torch.tensor([p.encode(p.prior[0]) for p in BASE], dtype=F64)


def test_errors_of_the_impact_law_are_pushes_at_the_touching_point_and_turns_of_any_axis() -> None:
    world, seen = tilted_world(), impacts()
    body, normal = world.bodies[0], world.ground_normal
    assert normal is not None
    found = ImpactProblem(world, BASE, seen)._scatter()
    across = tangent_axes(normal)[1:].numpy()
    for k in range(len(seen)):
        turn = seen.rotation[k].numpy()
        arm = -RADIUS_M * normal.numpy() - turn @ body.com[0].numpy()
        inertia = turn @ body.inertia[0].numpy() @ turn.T
        change = (seen.after[k] - seen.before[k]).numpy()
        tangential, up = np.linalg.norm(across @ change[:3]), normal.numpy() @ change[:3]
        wanted, size = np.zeros((6, 6)), np.linalg.norm(arm)
        for axis in across:  # a push of unit size along it changes velocity and spin of the body
            push = float(body.mass[0]) * (FRICTION_SHARE * tangential + IMPULSE_SHARE * up) * axis
            row = np.concatenate(
                [[0.0], across @ push / float(body.mass[0]), size * np.linalg.solve(inertia, np.cross(arm, push))]
            )
            wanted += np.outer(row, row)
        wanted[3:, 3:] += (SPIN_SHARE * size * np.linalg.norm(change[3:])) ** 2 * np.eye(3)
        wanted[0, 0] += (REBOUND_SHARE * normal.numpy() @ seen.after[k, :3].numpy()) ** 2
        np.testing.assert_allclose(found[k], wanted, rtol=1e-9, atol=1e-15)


def test_weights_are_of_the_errors_of_twists_and_of_the_law() -> None:
    """The residuals' own derivatives by the twists, here by larger steps of each one, and the law's errors."""
    world, seen = tilted_world(), impacts()
    problem, value = ImpactProblem(world, BASE, seen), usual()
    white = problem.whitened(value).whitening
    assert white is not None
    cover = problem._scatter()
    for name, own in (("before", seen.covariance_before), ("after", seen.covariance_after)):
        columns = []
        for k in range(6):
            step = torch.zeros(6, dtype=F64)
            step[k] = 3e-4 if k < 3 else 3e-3
            ends = [problem.residuals(value[None], **{name: getattr(seen, name) + s * step})[0] for s in (1, -1)]
            columns.append((ends[0] - ends[1]) / (2 * float(step[k])))
        slope = torch.stack(columns, -1)
        cover = cover + slope @ own @ slope.mT
    torch.testing.assert_close(
        white @ cover @ white.mT, torch.eye(6, dtype=F64).expand(len(seen), 6, 6), rtol=0, atol=2e-3
    )


def test_slopes_by_one_parameter_are_columns_of_those_by_all() -> None:
    problem = ImpactProblem(tilted_world(), BASE, impacts()).whitened(usual())
    values = usual().expand(2, -1) + torch.tensor([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1]], dtype=F64)
    rows, slope = problem.linear(values)
    torch.testing.assert_close(rows, problem.rows(values))
    columns = torch.tensor([2, 0, 1])
    torch.testing.assert_close(problem.slopes(values[1:].expand(3, -1), columns), slope[1][..., columns])
    for k, parameter in enumerate(BASE):
        step = torch.zeros(3, dtype=F64)
        step[k] = 0.004 * parameter.prior[1]
        exact = (problem.rows(values + step) - problem.rows(values - step)) / (2 * float(step[k]))
        assert float((slope[..., k] - exact).abs().max()) < 0.1 * float(exact.abs().max())
        high = values[:1].clone()
        high[0, k] = parameter.limits[1]
        at_bound = problem._steps(high)[0]
        assert float(at_bound[k]) < 0 and bool((at_bound[torch.arange(3) != k] > 0).all())
        torch.testing.assert_close(at_bound.abs(), problem._steps(values[:1])[0].abs())


def test_an_impact_of_weight_two_counts_as_two_and_one_of_weight_zero_as_none() -> None:
    seen, start = impacts(), usual()
    problem = ImpactProblem(tilted_world(), BASE, seen).whitened(start)
    weights = np.ones((3, len(seen)))
    weights[1, 2], weights[2, [0, 4]] = 2.0, 0.0
    every, twice, without = fits_to_weighted(problem, start, weights, start)

    def chosen(rows: list[int]) -> ImpactProblem:
        fields = {name: None if value is None else value[rows] for name, value in vars(seen).items()}
        assert problem.whitening is not None
        return replace(problem, impacts=Impacts(**fields), whitening=problem.whitening[rows])

    for found, rows in ((every, range(7)), (twice, [*range(7), 2]), (without, [1, 2, 3, 5, 6])):
        alone = fit_impacts(chosen(list(rows)), start)
        np.testing.assert_allclose(found.values, alone.values, atol=1e-8)
        np.testing.assert_allclose(found.information, alone.information, rtol=1e-8, atol=1e-8)
        assert found.prior == pytest.approx(alone.prior)
    width = np.array([p.prior[1] for p in BASE])
    away = (every.values - start.numpy()) / width
    assert every.prior == pytest.approx(away @ away)
    assert every.chi2.sum() == pytest.approx((every.rows**2).sum()) and every.chi2[0] == pytest.approx(
        (every.rows[:, 0] ** 2).sum()
    )
    # no step along a parameter lowers the sum of squares by more than the fit's tolerance
    best = every.chi2.sum() + every.prior
    for k in range(3):
        for step in (-0.3, 0.3):
            moved = torch.as_tensor(every.values).clone()
            moved[k] += step * width[k]
            moved[k] = moved[k].clamp(*BASE[k].limits)
            prior = float((((moved - start) / torch.as_tensor(width)) ** 2).sum())
            assert float(problem.rows(moved[None]).square().sum()) + prior > best - 0.1


def test_a_base_is_weighed_at_its_own_fit_and_begins_at_usual_values() -> None:
    world, seen = tilted_world(), impacts()
    base = ImpactBase.of(world, seen)
    torch.testing.assert_close(base.centre, usual())
    assert base.parameters == BASE
    first = fit_impacts(ImpactProblem(world, BASE, seen).whitened(usual()), usual())
    again = ImpactProblem(world, BASE, seen).whitened(torch.as_tensor(first.values))
    second = fit_impacts(again, torch.as_tensor(first.values), usual())
    np.testing.assert_allclose(base.fit.values, second.values)
    with pytest.raises(ValueError, match="no weights"):
        ImpactProblem(world, BASE, seen).rows(usual()[None])


def test_an_impact_that_follows_the_law_leaves_nothing() -> None:
    """A ball about its middle, of any inertia: twists after impacts are those that the law gives from those before."""
    world, seen = tilted_world(), impacts()
    body = replace(world.bodies[0], com=torch.zeros(1, 3, dtype=F64))
    world = replace(world, bodies=(body,))
    problem = ImpactProblem(world, BASE, seen)
    one = problem._impact(world, seen.before)
    rebound = rebound_speed(one, contact_law(world), ())
    closing = point_velocity(seen.before, one.arm) @ one.normal
    pushed = replace(one, impulse=body.mass * (rebound - closing))
    after = after_impact(pushed, contact_law(world), ())
    torch.testing.assert_close(point_velocity(after, one.arm) @ one.normal, rebound)
    known = base_values(world, BASE)[None]
    left = problem.residuals(known, after=after)[0]
    torch.testing.assert_close(left, torch.zeros_like(left), rtol=0, atol=1e-9)
    along = tangent_axes(one.normal)[1:]
    turned = after + torch.tensor([0.0, 0.0, 0.0, 0.3, -0.2, 0.7], dtype=F64)
    left = problem.residuals(known, after=turned)[0]
    torch.testing.assert_close(left[:, 3:], RADIUS_M * (turned - after)[:, 3:])
    aside = after + torch.cat([0.03 * along[0] - 0.02 * along[1], torch.zeros(3, dtype=F64)])
    left = problem.residuals(known, after=aside)[0]
    torch.testing.assert_close(left[:, 1:3], torch.tensor([[0.03, -0.02]], dtype=F64).expand(len(seen), 2))
    assert float(left[:, [0, 3, 4, 5]].abs().max()) < 1e-9
    higher = after + torch.cat([0.05 * one.normal, torch.zeros(3, dtype=F64)])
    assert problem.residuals(known, after=higher)[0][:, 0].tolist() == pytest.approx([0.05] * len(seen))
