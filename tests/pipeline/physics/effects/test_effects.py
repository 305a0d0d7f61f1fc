"""The built-in effects against mechanics, their derivatives against each other, and effects of one's own."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch
from cgwm.datasets import Track
from cgwm.pipeline.geometry.rotation import geodesic_angle, quat_multiply, quat_rotate
from cgwm.pipeline.optimization.forward_mode import batched_jacobian
from cgwm.pipeline.physics import Body, PaperLaw, Rollout, State, World, simulate
from cgwm.pipeline.physics.effects import (
    ActiveEffect,
    BodyMotion,
    Effect,
    Poses,
    load_effect,
)
from cgwm.pipeline.physics.effects.registry import BUILT_IN
from cgwm.pipeline.physics.effects.residual_wrench import ResidualWrench
from cgwm.pipeline.physics.engine import rollout as roll_out
from cgwm.pipeline.physics.fused.host import lacking, simulate_on_host
from cgwm.pipeline.runtime.kernel_build import compiler
from cgwm.schemas import UsageError
from helpers.fused_host import built_as_for_users
from helpers.worlds import F64, ball_body, batch, box_body, law, state_of, times, world_of

UP = (1.0, 0.0, 0.0, 0.0)
TILTED = (0.92, 0.3, 0.2, 0.1)
STEP_S = 0.00101
"""A step [s] that no frame is a multiple of, so that a clock that runs a little fast does not take one more step."""
MU, G = 0.3, 9.81


def active(name: str, **values: float | torch.Tensor) -> ActiveEffect:
    return ActiveEffect.of(load_effect(name), values, batch(0.0))


def observed(world: World, state: State, times_s: torch.Tensor, tracks: Mapping[str, Track] | None = None) -> Poses:
    """Roll out to the true times, and return what is measured."""
    true = times_s[None]
    for effect in world.effects:
        if effect.effect.has("times"):
            true = effect.effect.times(effect.values, true)
    rollout = simulate(world, state, true, tracks)
    poses = Poses(rollout.position_m, rollout.quat_wxyz)
    for effect in world.effects:
        if effect.effect.has("observe"):
            poses = effect.effect.observe(effect.values, poses)
    return poses


def rolled(world: World, state: State, duration_s: float, *effects: ActiveEffect, rate_hz: float = 100.0):
    """Roll out in the kernel where a compiler is: that the torch engine agrees is the law of `test_fused.py`."""
    return roll_out(replace(world, effects=effects), state, times(duration_s, rate_hz))


# Every effect: neutral, differentiable, and the same in the kernel; all of them in one batch, as a step takes equally
# long for one row and for a hundred


GROUPS = [[n for n in BUILT_IN if ("driven" in load_effect(n).needs) == driven] for driven in (False, True)]
"""Effects that can be in one world: in the kernel those of the contact are for a body alone on the ground."""
ROWS = 3
SPAN_S = 0.013
"""Time of the derivatives: the corner grazes for its last steps."""


@dataclass(frozen=True)
class Scenes:
    """Short motions in one world with all effects of a group, of which each acts in rows of its own.

    The three of each effect: high flight; a slide on four corners, with spin; a corner that begins to graze.
    """

    effects: tuple[Effect, ...]
    world: World
    state: State
    tracks: Mapping[str, Track] | None = None

    def rows(self, name: str) -> slice:
        """Return the rows of an effect."""
        place = [effect.name for effect in self.effects].index(name)
        return slice(ROWS * place, ROWS * (place + 1))

    def acting(self, x: torch.Tensor) -> World:
        """Return the world of effects with parameters x (K B, P), in units of their scales, those of the row's own."""
        copies = len(x) // (ROWS * len(self.effects))
        effects = []
        for effect in self.effects:
            own = torch.zeros(ROWS * len(self.effects), dtype=F64)
            own[self.rows(effect.name)] = 1.0
            own = own.repeat(copies)
            values = {p.name: p.scale * own * x[:, k] for k, p in enumerate(effect.parameters)}
            if effect.name == "linear_drag":  # what others cannot do without
                values["c"] = values["c"] + self.drag().repeat(copies)
            effects.append(ActiveEffect(effect, {**ActiveEffect.of(effect).values, **values}))
        return replace(self.world, effects=tuple(effects))

    def drag(self) -> torch.Tensor:
        """Return the linear drag of each row that its effect cannot do without."""
        needs = torch.tensor(["drag" in effect.needs for effect in self.effects], dtype=F64)
        return 0.5 * needs.repeat_interleave(ROWS)

    def bare(self) -> World:
        """Return the world without effects but the drag that some need."""
        needed = (active("linear_drag", c=self.drag()),) if bool(self.drag().any()) else ()
        return replace(self.world, effects=needed)

    def sizes(self) -> list[int]:
        return [len(effect.parameters) for effect in self.effects]


def scenes(group: int, *others: Effect) -> Scenes:
    lowest = float(quat_rotate(state_of(((0, 0, 0), TILTED, (0, 0, 0), (0, 0, 0))).quat_wxyz[0], corners()).amin(0)[2])
    grazing = -lowest + 0.001 + 0.0027
    rows = [
        ((0.02, 0.01, 0.5), TILTED, (2.0, 1.0, -0.5), (9.0, -5.0, 7.0)),
        ((0.03, 0.02, 0.02995), UP, (0.5, 0.3, 0.0), (0.3, -0.2, 3.0)),
        ((0.01, 0.03, grazing), TILTED, (0.4, -0.2, -0.15), (2.0, 3.0, 1.0)),
    ]
    effects = (*(load_effect(name) for name in GROUPS[group]), *others)
    world, tracks = replace(world_of(box_body(radius=0.001)), step_s=STEP_S), None
    if any("driven" in effect.needs for effect in effects):
        tip = replace(ball_body(radius=0.01, name="tip"), motion="driven")
        world = replace(world, bodies=(*world.bodies, tip))
        at = np.linspace(-0.1, 0.2, 31) + 0.0045
        path = np.stack((-0.3 + 0.4 * at + 3 * at**2, 0 * at, 0.5 + 0 * at), -1)
        tracks = {"tip": Track(at, path)}
    still = ((-0.3, 0.0, 0.5), UP, (0, 0, 0), (0, 0, 0))
    states = [state_of(row, *([still] if tracks else [])) for row in rows]
    return Scenes(effects, world, State.joined(*states * len(effects)), tracks)


def corners() -> torch.Tensor:
    return box_body().centers[0]


def test_the_scenes_are_a_flight_a_contact_and_a_graze() -> None:
    there = scenes(0)
    first = State(*(value[there.rows("friction_patch")] for value in vars(there.state).values()))
    world = replace(there.world, effects=(active("friction_patch", c_22=0.5),))
    record = simulate(world, first, times(SPAN_S, 1000.0), record_contacts=True).contacts
    assert record is not None
    pushes = record.impulse_n_s[..., 2].sum(-1) > 0
    touching = pushes.sum(1).tolist()
    assert touching[0] == 0 and touching[1] >= 10 and 2 <= touching[2] <= 8
    assert bool(record.sliding[1].any())
    assert not bool(pushes[2, :5].any())


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of the poses by the parameters of each row's effect, in units of their scales."""

    forward: torch.Tensor
    """Of forward mode, (B, M, P)."""
    weights: torch.Tensor
    """Of a random combination of the outputs, (B, M)."""
    backward: torch.Tensor
    """Of that combination, in reverse mode, (B, P)."""
    numeric: torch.Tensor
    """Differences, one-sided where a parameter may not be negative, (B, M, P)."""


@cache
def derivatives(group: int, at: float) -> Derivatives:
    there = scenes(group)
    size, count = max(there.sizes()), len(there.state.position_m)

    def function(x: torch.Tensor, repeats: int) -> torch.Tensor:
        """Return what is measured."""
        copies = len(x) // count
        state = State(*(value.repeat(copies, *[1] * (value.ndim - 1)) for value in vars(there.state).values()))
        poses = observed(there.acting(x), state, times(SPAN_S), there.tracks)
        return torch.cat((poses.position_m[:, 1:].flatten(1), poses.quat_wxyz[:, 1:].flatten(1)), -1)

    x = torch.zeros(count, size, dtype=F64)
    for effect, its in zip(there.effects, there.sizes(), strict=True):
        x[there.rows(effect.name), :its] = at * torch.linspace(1.0, 0.5, its, dtype=F64)
    value, forward = batched_jacobian(function, x)
    weights = torch.randn(value.shape, generator=torch.Generator().manual_seed(1), dtype=F64)
    leaf = x.clone().requires_grad_()
    (backward,) = torch.autograd.grad((weights * function(leaf, 1)).sum(), leaf)
    h = 1e-4
    one_sided = torch.tensor([at == 0 and all(p.nonnegative for p in effect.parameters) for effect in there.effects])
    one_sided = one_sided.repeat_interleave(ROWS)[:, None]
    steps = [torch.where(one_sided, k, k - 1.0) for k in (0.0, 1.0, 2.0)]
    factors = [torch.where(one_sided, a, b) for a, b in ((-1.5, -0.5), (2.0, 0.0), (-0.5, 0.5))]
    moved = torch.cat([x + h * step * axis for step in steps for axis in torch.eye(size, dtype=F64)])
    with torch.no_grad():
        ends = function(moved, 1).unflatten(0, (len(steps), size, count))
    numeric = sum(factor * end for factor, end in zip(factors, ends, strict=True)).permute(1, 2, 0) / h
    return Derivatives(forward, weights, backward, numeric)


@pytest.mark.parametrize("name", BUILT_IN)
@pytest.mark.parametrize("at", [pytest.param(0.0, marks=pytest.mark.evidence), 0.7])
def test_derivatives_agree_in_flight_in_contact_and_grazing(name: str, at: float) -> None:
    group = next(k for k, names in enumerate(GROUPS) if name in names)
    rows, size, found = scenes(group).rows(name), len(load_effect(name).parameters), derivatives(group, at)
    forward, numeric = found.forward[rows, :, :size], found.numeric[rows, :, :size]
    assert bool(torch.isfinite(forward).all())
    combined = (found.weights[rows, None] @ forward).squeeze(1)
    torch.testing.assert_close(found.backward[rows, :size], combined, atol=1e-11, rtol=1e-8)
    largest = float(forward.abs().max())
    assert largest > 1e-8
    torch.testing.assert_close(forward, numeric, atol=2e-6 * largest + 1e-10, rtol=1e-5)


def test_every_effect_is_nothing_at_zero() -> None:
    """A box that drops on a corner, and a ball that slides until it rolls."""
    drag = active("linear_drag", c=0.5)

    def seen(names: Iterable[str], body: Body, row: tuple) -> Poses:
        effects = (drag, *(active(name) for name in names))
        return observed(replace(world_of(body), step_s=0.002, effects=effects), state_of(row), times(0.06))

    for body, row in (
        (box_body(), ((0.1, 0.05, 0.055), TILTED, (0.3, 0.1, -0.5), (2.0, 1.0, -1.0))),
        (ball_body(), ((0.1, 0.05, 0.0399), UP, (0.4, 0.2, 0.0), (1.0, 2.0, 3.0))),
    ):
        plain, with_all = seen((), body, row), seen(BUILT_IN, body, row)
        torch.testing.assert_close(with_all.position_m, plain.position_m, atol=1e-13, rtol=0)
        torch.testing.assert_close(with_all.quat_wxyz, plain.quat_wxyz, atol=1e-13, rtol=0)


@cache
def in_both_engines(group: int) -> tuple[Scenes, Rollout, Rollout, Rollout]:
    """Return rollouts of the torch engine, of the kernel, and of the torch engine without the effects."""
    there = scenes(group, *([ResidualWrench()] if group == 0 else []))
    shares = 0.7 / torch.arange(1, 1 + max(there.sizes()), dtype=F64)
    world = there.acting(shares.repeat(len(there.state.position_m), 1))
    assert lacking(world) is None, "the kernel must have every built-in effect"
    with built_as_for_users():
        found = simulate_on_host(world, there.state, times(0.05), there.tracks)
    expected, without = (simulate(at, there.state, times(0.05), there.tracks) for at in (world, there.bare()))
    return there, expected, found, without


@pytest.mark.skipif(compiler() is None, reason="needs a C++ compiler to build the kernel")
@pytest.mark.parametrize("name", [*BUILT_IN, ResidualWrench.name])
def test_every_effect_is_the_same_in_the_kernel(name: str) -> None:
    """The formula in torch and the kernel's text agree in flight, in a slide and in a graze, and both act."""
    there, expected, found, without = in_both_engines(int(name in GROUPS[1]))
    rows = there.rows(name)
    for key in ("position_m", "quat_wxyz", "velocity_m_s", "omega_body_rad_s"):
        torch.testing.assert_close(getattr(found, key)[rows], getattr(expected, key)[rows], rtol=1e-9, atol=1e-9)
    acts = (found.velocity_m_s - without.velocity_m_s)[rows].abs().max() > 1e-7
    acts |= (found.omega_body_rad_s - without.omega_body_rad_s)[rows].abs().max() > 1e-7
    effect = there.effects[rows.start // ROWS]
    assert bool(acts) == any(effect.has(hook) for hook in ("world", "flow", "wrench", "contact"))


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_effect_is_fully_declared(name: str) -> None:
    effect = load_effect(name)
    assert effect.name == name
    assert type(effect).__name__ == "".join(word.capitalize() for word in name.split("_"))
    texts = (effect.summary, effect.formula, effect.reveals, effect.source)
    assert all(text and not text.endswith(" ") for text in texts)
    assert all(p.unit and 0 < p.scale < p.limit < math.inf for p in effect.parameters)
    assert all(len(c.grid) >= 3 and list(c.grid) == sorted(c.grid) for c in effect.constants)
    assert effect.phase == "measurement" or not (effect.has("observe") or effect.has("times"))
    assert ("contact" in effect.needs) == (effect.phase == "contact")


# In flight


def in_flight(effect: ActiveEffect, *others: ActiveEffect, velocity=(0.0, 0.0, 0.0), omega=(0.0, 0.0, 0.0), s=0.5):
    """Return velocity and body spin of a box after s seconds without gravity."""
    world = world_of(box_body(half=(0.04, 0.04, 0.04)), ground=False, gravity=0.0)
    rollout = rolled(world, state_of(((0, 0, 1), UP, velocity, omega)), s, effect, *others, rate_hz=50.0)
    return rollout.velocity_m_s[0, -1, 0], rollout.omega_body_rad_s[0, -1, 0]


def test_linear_and_quadratic_drag_slow_a_body_as_they_should() -> None:
    velocity, _ = in_flight(active("linear_drag", c=2.0), velocity=(3.0, 0.0, 4.0))
    torch.testing.assert_close(velocity, math.exp(-1.0) * batch([3.0, 0.0, 4.0])[0], rtol=2e-3, atol=0)
    velocity, _ = in_flight(active("quadratic_drag", k=0.4), velocity=(3.0, 0.0, 4.0))
    torch.testing.assert_close(velocity, batch([3.0, 0.0, 4.0])[0] / (1 + 0.4 * 5 * 0.5), rtol=2e-3, atol=0)


@pytest.mark.parametrize(
    ("name", "value", "terminal"), [("linear_drag", 8.0, G / 8.0), ("quadratic_drag", 4.0, math.sqrt(G / 4.0))]
)
def test_a_falling_body_reaches_its_terminal_speed(name: str, value: float, terminal: float) -> None:
    parameter = load_effect(name).parameters[0].name
    world = world_of(ball_body(), ground=False)
    rollout = rolled(world, state_of(((0, 0, 0), UP, (0, 0, 0), (0, 0, 0))), 0.8, active(name, **{parameter: value}))
    assert float(rollout.velocity_m_s[0, -1, 0, 2]) == pytest.approx(-terminal, rel=0.01)


def test_spin_damping_slows_the_spin_alone() -> None:
    velocity, omega = in_flight(active("spin_damping", d=3.0), velocity=(1.0, 0.0, 0.0), omega=(4.0, -2.0, 6.0))
    torch.testing.assert_close(omega, math.exp(-1.5) * batch([4.0, -2.0, 6.0])[0], rtol=3e-3, atol=1e-9)
    torch.testing.assert_close(velocity, batch([1.0, 0.0, 0.0])[0], rtol=0, atol=1e-12)


def test_magnus_lift_turns_the_path_about_the_spin() -> None:
    """a = s omega x u with omega along z turns the velocity about z at the rate s omega."""
    velocity, _ = in_flight(active("magnus_lift", s=0.1), velocity=(2.0, 0.0, 0.5), omega=(0.0, 0.0, 10.0))
    expected = batch([2 * math.cos(0.5), 2 * math.sin(0.5), 0.5])[0]
    torch.testing.assert_close(velocity, expected, rtol=1e-3, atol=1e-3)


def test_spin_lift_turns_the_path_whatever_spin_the_body_has() -> None:
    """a = q x u turns the velocity about q at the rate of q, in the air: wind adds q x (u - w)."""
    velocity, _ = in_flight(active("spin_lift", q_z=1.0), velocity=(2.0, 0.0, 0.5), omega=(3.0, 0.0, 0.0))
    expected = batch([2 * math.cos(0.5), 2 * math.sin(0.5), 0.5])[0]
    torch.testing.assert_close(velocity, expected, rtol=1e-3, atol=1e-3)


def test_wind_carries_a_body_away_through_its_drag() -> None:
    wind = active("wind", w_x=2.0, w_y=-1.0)
    velocity, _ = in_flight(wind, active("linear_drag", c=20.0))
    torch.testing.assert_close(velocity, batch([2.0, -1.0, 0.0])[0], rtol=0, atol=1e-3)
    velocity, _ = in_flight(wind, active("quadratic_drag", k=0.3), velocity=(2.0, -1.0, 0.0))
    torch.testing.assert_close(velocity, batch([2.0, -1.0, 0.0])[0], rtol=0, atol=1e-12)


def test_two_winds_add_up() -> None:
    one, two = active("wind", w_x=2.0), active("wind", w_x=-0.5, w_y=1.0)
    velocity, _ = in_flight(one, two, active("linear_drag", c=20.0))
    torch.testing.assert_close(velocity, batch([1.5, 1.0, 0.0])[0], rtol=0, atol=1e-3)


def fallen(effect: ActiveEffect, ground: bool = True, height: float = 5.0) -> torch.Tensor:
    """Return the mean acceleration of a ball that falls for 0.1 s from rest."""
    world = world_of(ball_body(), ground=ground)
    rollout = rolled(world, state_of(((0, 0, height), UP, (0, 0, 0), (0, 0, 0))), 0.1, effect, rate_hz=10.0)
    return rollout.velocity_m_s[0, -1, 0] / 0.1


@pytest.mark.parametrize("ground", [True, False])
def test_forces_of_flight_accelerate_as_they_say(ground: bool) -> None:
    for effect, acceleration in (
        (active("constant_force", f_x=0.5, f_y=-0.3, f_z=0.2), (0.5, -0.3, -G + 0.2)),
        (active("buoyancy", b=1.5), (0.0, 0.0, -G + 1.5)),
        (active("gravity_scale", s=-0.1), (0.0, 0.0, -0.9 * G)),
        (active("gravity_tilt", tilt_x=0.1), (0.0, G * math.sin(0.1), -G * math.cos(0.1))),
        (active("gravity_tilt", tilt_y=0.1), (-G * math.sin(0.1), 0.0, -G * math.cos(0.1))),
    ):
        torch.testing.assert_close(fallen(effect, ground), batch(acceleration)[0], rtol=0, atol=1e-9)


def test_a_tilted_gravity_leaves_the_ground_and_makes_it_a_slope() -> None:
    world = world_of(ball_body(), contact=law(friction=0.0))
    start = state_of(((0, 0, 0.0399), UP, (0, 0, 0), (0, 0, 0)))
    rollout = rolled(world, start, 0.2, active("gravity_tilt", tilt_y=0.1))
    assert float(rollout.velocity_m_s[0, -1, 0, 0]) == pytest.approx(-0.2 * G * math.sin(0.1), rel=1e-6)
    assert abs(float(rollout.position_m[0, -1, 0, 2]) - 0.04) < 5e-4


def test_the_ground_magnet_pulls_with_a_at_the_ground_and_fades() -> None:
    effect = active("ground_magnet", A=4.0, l=0.05)
    world = world_of(ball_body(), gravity=0.0)
    for height, expected in ((1e-6, -4.0), (0.05, -4 * math.exp(-1)), (1.0, 0.0)):
        start = state_of(((0, 0, 0.04 + height), UP, (0, 0, 0), (0, 0, 0)))
        speed = rolled(world, start, 1e-3, effect, rate_hz=1000.0).velocity_m_s[0, -1, 0, 2]
        if height > 1e-3:
            assert float(speed) == pytest.approx(expected * 1e-3, rel=1e-4, abs=1e-9)
        else:  # what the pull gives, the contact takes
            motion = motion_at(world, start)
            force = effect.effect.wrench(effect.values, motion).force
            assert float(force[0, 2] / motion.mass) == pytest.approx(expected, rel=1e-4)


def motion_at(world: World, state: State) -> BodyMotion:
    """Return what effects see of the first body at rest."""
    body = world.bodies[0]
    eye, zero = torch.eye(3, dtype=F64)[None], torch.zeros(1, 3, dtype=F64)
    position = state.position_m[:, 0]
    return BodyMotion(
        body=body,
        mass=body.mass,
        inertia=body.inertia,
        com=position,
        rotation=eye,
        velocity=zero,
        omega=zero,
        up=world.up,
        normal=world.up,
        ground_offset=world.ground_offset,
    )


# In contact


def slid(body: Body, effect: ActiveEffect, velocity, duration: float = 0.2, friction: float = MU, start=(0.0, 0.0)):
    """Return a rollout of a body that slides from the given velocity on the ground."""
    lowest = float((body.radii - body.centers[..., 2]).amax())
    rest = lowest - G * 0.004**2
    state = state_of(((*start, rest), UP, velocity, (0.0, 0.0, 0.0)))
    return rolled(world_of(body, contact=law(friction=friction)), state, duration, effect)


FLAT = (0.05, 0.05, 0.01)


def deceleration(rollout, axis: int = 0) -> float:
    speed = rollout.velocity_m_s[0, :, 0, axis]
    return float((speed[2] - speed[-1]) / (rollout.times_s[-1] - rollout.times_s[2]))


@pytest.mark.parametrize("friction", [pytest.param(0.2, marks=pytest.mark.evidence), 0.6])
def test_rolling_resistance_slows_a_rolling_ball(friction: float) -> None:
    """m a = -f, I alpha = f r - c_r m g, v = omega r: a = -(c_r g / r) / (1 + I / (m r^2)) = -(5/7) c_r g / r."""
    radius, arm = 0.04, 1e-3
    world = world_of(ball_body(radius), contact=law(friction=friction))
    start = state_of(((0, 0, radius - 1e-4), UP, (0.5, 0, 0), (0, 0.5 / radius, 0)))
    rollout = rolled(world, start, 0.3, active("rolling_resistance", c_r=arm))
    assert deceleration(rollout) == pytest.approx(5 / 7 * arm * G / radius, rel=1e-3)
    slow = state_of(((0, 0, radius - 1e-4), UP, (0.01, 0, 0), (0, 0.01 / radius, 0)))
    stopped = rolled(world, slow, 0.3, active("rolling_resistance", c_r=arm))
    assert float(stopped.velocity_m_s[0, -1, 0].norm()) < 1e-6


@pytest.mark.parametrize("body", [ball_body(), box_body()], ids=["ball", "box"])
def test_torsional_friction_stops_a_spin_on_the_spot(body: Body) -> None:
    """I alpha = -c_t m g, whatever the number of points that touch."""
    arm, inertia = 2e-3, float(body.inertia[0, 2, 2])
    lowest = float((body.radii - body.centers[..., 2]).amax())
    start = state_of(((0, 0, lowest - G * 0.004**2), UP, (0, 0, 0), (0, 0, 5.0)))
    world = world_of(body, contact=law(friction=0.0))
    rollout = rolled(world, start, 0.1, active("torsional_friction", c_t=arm))
    spin = rollout.omega_body_rad_s[0, :, 0, 2]
    expected = arm * float(body.mass) * G / inertia
    assert float((spin[2] - spin[-1]) / 0.08) == pytest.approx(expected, rel=2e-3)
    stopped = rolled(world, start, 0.2 + 5.0 / expected, active("torsional_friction", c_t=arm))
    assert abs(float(stopped.omega_body_rad_s[0, -1, 0, 2])) < 1e-6


@pytest.mark.parametrize("friction", [0.0, 0.1])
def test_viscous_friction_slows_a_slider_of_four_corners(friction: float) -> None:
    """m dv/dt = -c_v v - mu m g, so v = (v0 + v_c) exp(-c_v t / m) - v_c with v_c = mu m g / c_v."""
    body = box_body(half=FLAT)
    rollout = slid(body, active("viscous_friction", c_v=0.8), (1.0, 0.0, 0.0), friction=friction)
    rate = 0.8 / float(body.mass)
    lag = friction * G / rate
    expected = (1 + lag) * math.exp(-rate * 0.2) - lag
    assert float(rollout.velocity_m_s[0, -1, 0, 0]) == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize(("change", "expected"), [(0.2, 0.5), (-0.1, 0.2), (-0.6, 0.0)])
def test_stribeck_friction_is_that_of_slow_slip(change: float, expected: float) -> None:
    """Far below v_s the friction is mu + d, far above it mu; below 0 there is none."""
    body = box_body(half=FLAT)
    slow = slid(body, active("stribeck_friction", d=change, v_s=1e4), (1.0, 0.0, 0.0), 0.1)
    assert deceleration(slow) == pytest.approx(expected * G, rel=5e-3, abs=1e-6)
    fast = slid(body, active("stribeck_friction", d=change, v_s=1e-3), (1.0, 0.0, 0.0), 0.1)
    assert deceleration(fast) == pytest.approx(MU * G, rel=5e-3)


def test_anisotropic_friction_brakes_by_direction() -> None:
    body = box_body(half=FLAT)
    for axis, velocity, effect, expected in (
        (0, (1.0, 0.0, 0.0), active("anisotropic_friction", a=0.1), MU + 0.1),
        (1, (0.0, 1.0, 0.0), active("anisotropic_friction", a=0.1), MU - 0.1),
        (1, (0.0, 1.0, 0.0), active("anisotropic_friction", a=0.5), 0.1 * (MU + 0.5)),
        (0, (0.7, 0.7, 0.0), active("anisotropic_friction", b=0.1), (MU + 0.1) / math.sqrt(2)),
        (0, (0.7, -0.7, 0.0), active("anisotropic_friction", b=0.1), (MU - 0.1) / math.sqrt(2)),
    ):
        rollout = slid(body, effect, velocity, 0.1)
        assert deceleration(rollout, axis) == pytest.approx(expected * G, rel=5e-3, abs=1e-6)


def test_a_friction_patch_slows_only_there() -> None:
    body = box_body(half=(0.005, 0.005, 0.002))
    middle = active("friction_patch", c_22=0.4, p=0.1)
    here = slid(body, middle, (0.5, 0.0, 0.0), 0.04)
    assert deceleration(here) == pytest.approx((MU + 0.4 * 0.75**2) * G, rel=0.05)
    there = slid(body, middle, (0.5, 0.0, 0.0), 0.04, start=(0.2, 0.0))
    assert deceleration(there) == pytest.approx(MU * G, rel=1e-2)
    side = slid(body, active("friction_patch", c_32=0.4, p=0.1), (0.5, 0.0, 0.0), 0.04, start=(0.09, 0.0))
    assert deceleration(side) == pytest.approx(deceleration(here), rel=0.02)
    # equal coefficients are an even friction within the grid
    even = {p.name: 0.1 for p in load_effect("friction_patch").parameters}
    alike = slid(body, active("friction_patch", **even), (0.5, 0.0, 0.0), 0.04, start=(0.02, -0.03))
    assert deceleration(alike) == pytest.approx((MU + 0.1) * G, rel=1e-2)
    none = slid(body, active("friction_patch", c_22=-0.9, p=0.1), (0.5, 0.0, 0.0), 0.04)
    assert deceleration(none) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("damping_ratio", [0.05, 0.3, 0.7])
def test_velocity_restitution_falls_with_the_speed_of_the_impact(damping_ratio: float) -> None:
    """ln e falls by r v to first order, and by less than r v / 2 times that at the second."""
    speeds = torch.tensor([0.5, 1.0, 1.5], dtype=F64)
    rows = [state_of(((0, 0, 0.0402), UP, (0, 0, -float(v)), (0, 0, 0))) for v in speeds]
    start = State.joined(*rows)
    world = world_of(ball_body(), contact=law(damping_ratio=damping_ratio, contact_time_s=0.01), gravity=0.0)
    without, with_it = (
        rolled(replace(world, step_s=5e-4), start, 0.06, active("velocity_restitution", r=r), rate_hz=1 / 0.06)
        for r in (0.0, 0.2)
    )
    fall = -(with_it.velocity_m_s[:, -1, 0, 2] / without.velocity_m_s[:, -1, 0, 2]).log()
    first = 0.2 * speeds
    assert bool(((fall / first - 1).abs() < 0.03 + 0.5 * first).all())
    assert bool((fall.diff() > 0.05).all())


@pytest.mark.parametrize("corners_more", [1, 4])
def test_adhesion_holds_a_light_body_against_a_pull(corners_more: int) -> None:
    """It holds up to F, whatever the number of spheres, and lets go for good above."""
    body = box_body(mass=0.1)
    body = replace(body, centers=body.centers.repeat(1, corners_more, 1), radii=body.radii.repeat(1, corners_more))
    start = state_of(((0, 0, 0.03), UP, (0, 0, 0), (0, 0, 0)))
    heights = []
    for force in (0.9, 1.1):  # in units of F beyond the weight
        pull = active("constant_force", f_z=G + force * 0.3 / 0.1)
        rollout = rolled(world_of(body), start, 0.2, active("adhesion", F=0.3, g=1e-3), pull)
        heights.append(float(rollout.position_m[0, -1, 0, 2]) - 0.03)
    assert abs(heights[0]) < 1e-3
    assert heights[1] > 5e-3


def test_adhesion_turns_a_body_that_stands_on_an_edge() -> None:
    """The pull acts on the spheres within the gap alone: those of the lower side."""
    turn = math.radians(10)
    quat = (math.cos(turn / 2), 0.0, math.sin(turn / 2), 0.0)  # about y: the side of +x goes down
    lowest = float(quat_rotate(torch.tensor([quat], dtype=F64), corners()).amin(0)[2])
    start = state_of(((0, 0, -lowest + 0.001 + 2e-4), quat, (0, 0, 0), (0, 0, 0)))
    world = world_of(box_body(), gravity=0.0)
    rollout = rolled(world, start, 2e-3, active("adhesion", F=0.3, g=2e-3), rate_hz=1000.0)
    assert float(rollout.velocity_m_s[0, 1, 0, 2]) < 0
    assert float(rollout.omega_body_rad_s[0, 1, 0, 1]) > 0


# Of bodies and measurements


def test_a_moved_centre_of_mass_flies_on_the_parabola() -> None:
    offset = torch.tensor([0.01, -0.02, 0.005], dtype=F64)
    effect = active("com_offset", **{f"d_{axis}": float(d) for axis, d in zip("xyz", offset, strict=True)})
    world = world_of(box_body(half=(0.04, 0.04, 0.04)), ground=False)
    start = state_of(((0.1, 0.2, 1.0), TILTED, (0.3, 0.1, 1.0), (4.0, -3.0, 6.0)))
    rollout = rolled(world, start, 0.4, effect)
    com = rollout.position_m[0, :, 0] + quat_rotate(rollout.quat_wxyz[0, :, 0], offset)
    arm = quat_rotate(start.quat_wxyz[0, 0], offset)
    spin = quat_rotate(start.quat_wxyz[0, 0], start.omega_body_rad_s[0, 0])
    velocity = start.velocity_m_s[0, 0] + torch.linalg.cross(spin, arm)
    t = rollout.times_s[:, None]
    parabola = com[0] + velocity * t - 0.5 * G * t**2 * batch([0.0, 0.0, 1.0])
    torch.testing.assert_close(com, parabola, atol=1e-10, rtol=0)


def test_a_moved_marker_is_seen_where_it_is_and_moves_nothing() -> None:
    world = world_of(box_body())
    start = state_of(((0.1, 0.2, 0.1), TILTED, (0.3, 0.1, 0.0), (4.0, -3.0, 6.0)))
    plain = simulate(world, start, times(0.1))
    seen = observed(replace(world, effects=(active("marker_offset", d_x=0.01, d_z=-0.02),)), start, times(0.1))
    arm = quat_rotate(plain.quat_wxyz, batch([0.01, 0.0, -0.02]))
    torch.testing.assert_close(seen.position_m, plain.position_m + arm, atol=1e-14, rtol=0)
    torch.testing.assert_close(seen.quat_wxyz, plain.quat_wxyz, atol=0, rtol=0)


def test_a_stretched_inertia_is_that_of_a_stretched_mass() -> None:
    """Points of mass m at x have the inertia sum of m (x^2 - x x^T); stretched, they lie at exp(S / 2) x."""
    generator = torch.Generator().manual_seed(2)
    points = torch.randn(20, 3, generator=generator, dtype=F64) * torch.tensor([0.03, 0.02, 0.005], dtype=F64)

    def inertia(x: torch.Tensor) -> torch.Tensor:
        return 0.01 * (x.square().sum() * torch.eye(3, dtype=F64) - x.T @ x)

    body = replace(box_body(), inertia=inertia(points)[None])
    values = {"s_xx": 0.8, "s_yy": -0.9, "s_zz": 0.3, "s_xy": 0.5, "s_xz": -0.7, "s_yz": 0.2}
    effect = active("inertia_shape", **values)
    found = effect.effect.world(effect.values, world_of(body)).bodies[0].inertia[0]
    s = torch.tensor([[0.8, 0.5, -0.7], [0.5, -0.9, 0.2], [-0.7, 0.2, 0.3]], dtype=F64)
    torch.testing.assert_close(found, inertia(points @ torch.linalg.matrix_exp(0.5 * s)), rtol=1e-10, atol=1e-15)
    moments = torch.linalg.eigvalsh(found)
    assert float(moments[0]) > 0 and float(moments[0] + moments[1]) > float(moments[2])
    even = active("inertia_shape", s_xx=0.4, s_yy=0.4, s_zz=0.4)
    scaled = even.effect.world(even.values, world_of(body)).bodies[0].inertia[0]
    torch.testing.assert_close(scaled, math.exp(0.4) * inertia(points), rtol=1e-10, atol=1e-15)


def test_wrong_units_clocks_and_frames_are_seen_as_they_say() -> None:
    world = world_of(box_body(), ground=False)
    start = state_of(((0.1, 0.2, 1.0), TILTED, (0.3, 0.1, 1.0), (4.0, -3.0, 6.0)))
    plain = rolled(world, start, 0.1)

    def seen(name: str, **values: float) -> Poses:
        return observed(replace(world, effects=(active(name, **values),)), start, times(0.1))

    torch.testing.assert_close(seen("length_scale", s=0.1).position_m, 1.1 * plain.position_m, rtol=1e-14, atol=0)
    # a clock that is 10 % fast shows after 0.11 s what is there after 0.1 s
    late = simulate(world, start, times(0.1) / 1.1)
    torch.testing.assert_close(seen("clock_scale", s=0.1).position_m, late.position_m, rtol=0, atol=1e-14)
    tilted = seen("frame_tilt", tilt_x=0.2)
    turn = batch([math.cos(0.1), math.sin(0.1), 0.0, 0.0])
    torch.testing.assert_close(tilted.position_m, quat_rotate(turn, plain.position_m), rtol=0, atol=1e-14)
    expected = quat_multiply(turn.expand_as(plain.quat_wxyz), plain.quat_wxyz)
    assert float(geodesic_angle(tilted.quat_wxyz, expected).max()) < 1e-7
    # seen in it, gravity is turned as gravity_tilt turns it
    acceleration = (tilted.position_m.diff(n=2, dim=1) / 0.01**2)[0, 0, 0]
    gravity = active("gravity_tilt", tilt_x=0.2)
    torch.testing.assert_close(acceleration, gravity.effect.world(gravity.values, world).gravity[0], rtol=0, atol=1e-9)


def test_a_frame_tilts_about_the_axes_across_its_own_up() -> None:
    poses = Poses(batch([[[1.0, 0.0, 0.0]]]), batch([[UP]]), up=batch([1.0, 0.0, 0.0]))
    one = active("frame_tilt", tilt_x=0.1, tilt_y=0.2)
    tilted = one.effect.observe(one.values, poses).position_m[0, 0, 0]
    assert float(tilted[0]) == pytest.approx(math.cos(math.hypot(0.1, 0.2)), abs=1e-12)


def test_a_time_offset_shifts_the_commands_against_the_measurement() -> None:
    tip = replace(ball_body(radius=0.01, name="tip"), motion="driven")
    world = replace(world_of(tip), effects=(active("time_offset", o=0.03),))
    track = Track(np.array([0.0, 1.0]), np.array([[0.0, 0, 0.5], [2.0, 0, 0.5]]))
    seen = observed(world, state_of(((0, 0, 0.5), UP, (0, 0, 0), (0, 0, 0))), times(0.1), {"tip": track})
    torch.testing.assert_close(seen.position_m[0, 5:, 0, 0], 2 * (times(0.1)[5:] - 0.03), rtol=0, atol=1e-12)


# What is refused


def test_what_an_effect_needs_and_does_not_get_is_refused() -> None:
    start = state_of(((0, 0, 1), UP, (0, 0, 0), (0, 0, 0)))
    with pytest.raises(UsageError) as error:
        rolled(world_of(ball_body(), ground=False), start, 0.1, active("ground_magnet", A=1.0))
    assert str(error.value) == (
        "the effect 'ground_magnet' needs a ground, and this world has none.\n"
        "Next: give the ground in capture.toml, under [world], or leave the effect out."
    )
    with pytest.raises(UsageError) as error:
        rolled(world_of(ball_body()), start, 0.1, active("wind", w_x=1.0))
    assert str(error.value) == (
        "the effect 'wind' acts through air resistance, and the model has none.\n"
        "Next: add a drag: --effects wind,linear_drag or wind,quadratic_drag."
    )


def test_the_published_law_takes_effects_on_friction_alone() -> None:
    published = PaperLaw.of_rows(batch(MU), batch(2000.0), batch(10.0))
    world = replace(world_of(box_body(half=FLAT)), contact=published)
    start = state_of(((0, 0, 0.0099), UP, (1, 0, 0), (0, 0, 0)))
    speeds = [
        float(rolled(world, start, 0.05, active("stribeck_friction", d=d, v_s=0.5)).velocity_m_s[0, -1, 0, 0])
        for d in (0.0, 0.3)
    ]
    assert speeds[1] < speeds[0] - 0.01
    others = {"rolling_resistance": "c_r", "viscous_friction": "c_v", "velocity_restitution": "r"}
    for name, value in (others | {"anisotropic_friction": "a"}).items():
        with pytest.raises(UsageError, match=f"the effect '{name}' changes what the published contact law does not"):
            rolled(world, start, 0.05, active(name, **{value: 0.1}))


def test_unknown_numbers_of_an_effect_are_refused() -> None:
    with pytest.raises(KeyError, match="linear_drag has no k; it has c"):
        active("linear_drag", k=1.0)
    numbers = active("ground_magnet").values
    assert {name: float(value) for name, value in numbers.items()} == {"A": 0.0, "l": 0.05}


@pytest.mark.parametrize("name", ["adhesion", "ground_magnet"])
def test_what_acts_near_the_ground_does_not_depend_on_where_the_ground_lies(name: str) -> None:
    ball, values, force = ball_body(0.04), dict.fromkeys(("F", "g", "A", "l"), batch(0.02)), []
    for offset in (0.0, 0.7):
        world = replace(world_of(ball), ground_offset=batch(offset))
        motion = motion_at(world, state_of(((0.0, 0.0, offset + 0.045), UP, (0, 0, 0), (0, 0, 0))))
        force.append(load_effect(name).wrench(values, motion).force)
    torch.testing.assert_close(force[1], force[0])
    assert float(force[0][0, 2].abs()) > 1e-6
