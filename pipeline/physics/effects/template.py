"""Custom effect for cgwm, which runs unchanged:  cgwm effects show FILE.py:MyEffect.

Change the name, the texts and the formula. Everything is torch on batches of n rollouts, so that derivatives flow
through it: use no `if` on values, no `.item()`, no numpy. With all parameters 0 the effect must change nothing, and
have a finite derivative (sqrt(x) has none at 0; `length` is a norm that has one).
"""

from __future__ import annotations

import torch

from .effect import BodyMotion, Effect, EffectConstant, EffectParameter, Values, Wrench


class MyEffect(Effect):
    """Spring to the vertical line through the world's origin that vanishes far from it."""

    name = "my_effect"
    summary = "A pull towards the middle of the table."
    formula = "a = -w x exp(-(x^2 + y^2) / r^2), and the same for y"
    # Scale: a magnitude that changes a motion of 1 s visibly; a fit calls the parameter not observable where its
    # standard error exceeds four scales. A parameter that is physically never negative has nonnegative=True.
    parameters = (EffectParameter(name="w", unit="1/s2", scale=0.5, limit=50.0),)
    # A value without meaning where all parameters are 0 is a constant, which a fit tries on a grid.
    constants = (EffectConstant("r", "m", (0.1, 0.2, 0.5)),)
    phase = "flight"  # or "contact", or "measurement": where it acts
    needs = ()  # of "ground", "drag", "contact", "spin", "orientation", "driven"
    reveals = "slow flight past the middle, on different sides"
    source = "made up, as an example"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return force and torque on a free body, world frame; called in every step.

        `values` has each parameter and constant with shape (1,) or (n,). `motion` has mass (n,), inertia (n, 3, 3),
        com (n, 3), rotation (n, 3, 3), velocity and omega (n, 3), up (n or 1, 3), height (n,), and `airspeed` (n, 3).
        """
        x, y, _ = motion.com.unbind(-1)
        near = (-(x.square() + y.square()) / values["r"].square()).exp()
        pull = -values["w"] * motion.mass * near
        return Wrench(force=torch.stack((pull * x, pull * y, torch.zeros_like(pull)), -1))

    # The other methods; an effect may have any of them.
    #
    # contact(self, values, touch): the contact with other coefficients; called in every step for each touching pair.
    #     return dataclasses.replace(touch, friction=touch.friction + values["d"][:, None])
    # world(self, values, world): the world with other masses, geometry or gravity; called once for a rollout.
    #     return dataclasses.replace(world, gravity=world.gravity * (1 + values["s"])[:, None])
    # flow(self, values, motion): the velocity (n or 1, 3) of the air, which a drag takes into account.
    # times(self, values, times_s): the true times (n, T) of what was recorded at times_s.
    # observe(self, values, poses): what is measured of the true poses, position_m (n, T, bodies, 3) and quat_wxyz.
