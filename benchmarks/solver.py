"""The least-squares solver against scipy's on problems with known minima.

python benchmarks/solver.py

Each problem is solved by `optimization.least_squares` with one policy for all; by the same steps with geodesic
acceleration (Transtrum & Sethna, arXiv:1201.5885); by Powell's dogleg with a trust region in the scale of the columns
of the Jacobian; and by scipy's `least_squares` with trf, dogbox and lm, exact derivatives and the same scale. A figure
is the number of residual evaluations until the cost (sum of squares, or of Cauchy's loss) exceeds the known minimum by
less than 1e-6 of itself plus 1e-12 of the start, and in brackets how often derivatives were computed by then; "-" where
that was never reached, with the cost where it ended, and "n/a" where a method has no bounds, no robust loss, or too few
residuals. Takes some seconds, on one core.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from cgwm.pipeline.geometry.rotation import quat_conjugate, quat_exp, quat_log, quat_multiply
from cgwm.pipeline.optimization.least_squares import Policy, descend
from cgwm.pipeline.optimization.levenberg_marquardt import robust_loss
from cgwm.pipeline.optimization.problem import Box, NormalEquations, Point, Problem, Rows, damped, solved
from scipy.optimize import least_squares
from store import shared_data
from torch import Tensor
from torch.func import jacfwd, jvp

Residuals = Callable[[Tensor], Tensor]
POLICY = Policy(iterations=500, relative=1e-12, absolute=1e-20)
"""One policy for all problems; dampings are those of the fits."""
RELATIVE, ABSOLUTE = 1e-6, 1e-12
"""Excess over the minimum at which it counts as reached: of the minimum, and of the cost at the start."""
DECAY_MINIMUM, TOSS_MINIMUM = 146.8844397547871, 8534.000629264972
"""Least costs without a closed form: those on which this solver and trf agree to 14 digits."""
FRAMES = 20
"""Frames of the real toss."""
ACCELERATION = 0.75
"""Longest second-order part of a step, as a share of the first-order one (Transtrum & Sethna, section 3)."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A problem with a known minimum."""

    name: str
    """What it is."""
    residuals: Residuals
    """Parameters (P,) -> residuals (m,)."""
    start: tuple[float, ...]
    """Where the descent begins."""
    minimum: float
    """Least cost."""
    bounds: tuple[tuple[float, float], ...] | None = None
    """Lower and upper bound of each parameter."""
    scale: float | None = None
    """Scale of Cauchy's loss; None for squares."""


@dataclass(kw_only=True)
class Count:
    """What a method computed, and when it was there."""

    case: Case
    """The problem."""
    evaluations: int = 0
    """Residuals that were computed."""
    derivatives: int = 0
    """Jacobians that were computed."""
    reached: tuple[int, int] | None = None
    """Evaluations and derivatives when the minimum was reached."""
    best: float = math.inf
    """Least cost that was seen."""
    goal: float = field(init=False)
    """Cost at which the minimum counts as reached."""

    def __post_init__(self) -> None:
        start = self.cost(self.case.residuals(tensor(self.case.start)))
        self.goal = self.case.minimum * (1 + RELATIVE) + ABSOLUTE * start

    def cost(self, rows: Tensor) -> float:
        """Return the cost of residuals (m,)."""
        return float(robust_loss(rows.square(), self.case.scale)[0].sum())

    def value(self, x: Tensor) -> Tensor:
        """Return the residuals (m,) at parameters (P,), and count them."""
        rows = self.case.residuals(x)
        self.evaluations += 1
        self.best = min(self.best, self.cost(rows))
        if self.reached is None and self.best <= self.goal:
            self.reached = self.evaluations, self.derivatives
        return rows

    def jacobian(self, x: Tensor) -> Tensor:
        """Return the derivatives (m, P), and count them."""
        self.derivatives += 1
        return jacfwd(self.case.residuals)(x)  # pyright: ignore[reportReturnType]

    def text(self) -> str:
        """Return the entry of the table."""
        return f"{self.reached[0]} ({self.reached[1]})" if self.reached else f"- ({self.best:.3g})"


def tensor(values: object) -> Tensor:
    """Return numbers in double precision."""
    return torch.as_tensor(values, dtype=torch.float64)


class Counted(Problem):
    """A case as a problem of the solver, one group without states."""

    def __init__(self, count: Count, accelerated: bool = False) -> None:
        case = count.case
        self.count, self.accelerated, self.owner = count, accelerated, torch.zeros(1, dtype=torch.long)
        like = torch.zeros(1, len(case.start), dtype=torch.float64)
        self.box = Box.unbounded(like) if case.bounds is None else Box.within(tensor(case.bounds))

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """Return the cost (1,)."""
        del rows
        return tensor([self.count.cost(self.count.value(point.values[0]))])

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the normal equations; the residuals are known from the evaluation of the cost."""
        del rows
        x = point.values[0]
        found = self.count.case.residuals(x) if self.count.evaluations else self.count.value(x)
        loss, weight = robust_loss(found.square(), self.count.case.scale)
        jacobian = self.count.jacobian(x)
        return NormalEquations.of_rows(found[None], jacobian[None], len(x), loss.sum()[None], weight[None])


def ours(count: Count) -> None:
    """Solve by the least-squares solver."""
    descend(Counted(count), Point(values=tensor(count.case.start)[None]), POLICY)


def accelerated(count: Count) -> None:
    """Solve by the same damping with geodesic acceleration: a second-order part from a directional derivative.

    The directional derivative is counted as one evaluation, what it costs by differences.
    """
    case, x, damping = count.case, tensor(count.case.start), POLICY.damping
    box = Counted(count).box
    cost, stopped = count.cost(count.value(x)), False
    while not stopped:
        normal = Counted(count).linearised(Point(values=x[None]), Rows.of(torch.zeros(1, dtype=torch.long), 1))
        weight = robust_loss(case.residuals(x).square(), case.scale)[1]
        moving = box.moving(x[None], normal.slope)[0].to(x)
        while True:
            system = damped(normal.information, tensor([damping]))[0] * moving[:, None] * moving + torch.diag(
                1 - moving
            )
            first = solved(system[None], (normal.slope[0] * moving)[None, :, None])[0, :, 0]
            bend = jvp(lambda y, step=first: jvp(case.residuals, (y,), (step,))[1], (x,), (first,))[1]
            count.evaluations += 1
            slope = jacfwd(case.residuals)(x).T @ (weight * bend)  # pyright: ignore[reportAttributeAccessIssue]
            second = -0.5 * solved(system[None], (slope * moving)[None, :, None])[0, :, 0]
            size = (2 * second).norm() / first.norm().clamp_min(1e-300)
            moved = box.clamped((x + first + second)[None])[0] if size < ACCELERATION else x
            found = count.cost(count.value(moved)) if size < ACCELERATION else math.inf
            if found < cost:
                stopped = cost - found < max(POLICY.relative * cost, POLICY.absolute)
                x, cost, damping = moved, found, max(damping * POLICY.down, POLICY.least_damping)
                break
            damping *= POLICY.up
            if damping > POLICY.most_damping or count.evaluations > 2 * POLICY.iterations:
                return


def dogleg(count: Count) -> None:
    """Solve by Powell's dogleg (1970): a trust region in units of the largest columns of the Jacobian seen."""
    case, x = count.case, tensor(count.case.start)
    if case.bounds is not None:
        raise ValueError("the dogleg here has no bounds")
    cost, unit, radius = count.cost(count.value(x)), torch.zeros_like(x), 0.0
    while count.evaluations < POLICY.iterations:
        rows, jacobian = case.residuals(x), count.jacobian(x)
        root = robust_loss(rows.square(), case.scale)[1].sqrt()
        unit = torch.maximum(unit, (root[:, None] * jacobian).norm(dim=0)).clamp_min(1e-12)
        scaled, left = root[:, None] * jacobian / unit, root * rows
        radius = radius or float((unit * x).norm()) or 1.0
        gradient = scaled.T @ left
        newton = -torch.linalg.pinv(scaled) @ left
        cauchy = -gradient * (gradient @ gradient) / (scaled @ gradient).square().sum().clamp_min(1e-300)
        while True:
            step = _along(cauchy, newton, radius)
            found = count.cost(count.value(x + step / unit))
            foreseen = float(left.square().sum() - (left + scaled @ step).square().sum())
            ratio = (cost - found) / max(foreseen, 1e-300)
            if ratio < 0.25:
                radius = 0.25 * float(step.norm())
            elif ratio > 0.75 and float(step.norm()) > 0.9 * radius:
                radius *= 2
            if found < cost or radius < 1e-14 or count.evaluations >= POLICY.iterations:
                break
        if not found < cost:
            return
        fall, x, cost = cost - found, x + step / unit, found
        if fall < max(POLICY.relative * cost, POLICY.absolute):
            return


def _along(cauchy: Tensor, newton: Tensor, radius: float) -> Tensor:
    """Return the step (P,) of a dogleg within a radius."""
    if float(newton.norm()) <= radius:
        return newton
    if float(cauchy.norm()) >= radius:
        return cauchy * radius / cauchy.norm()
    way = newton - cauchy
    a, b, c = (float(one) for one in (way @ way, cauchy @ way, cauchy @ cauchy - radius**2))
    return cauchy + way * (-b + math.sqrt(max(b * b - a * c, 0.0))) / a


def by_scipy(count: Count, method: str) -> None:
    """Solve by scipy's `least_squares` with exact derivatives and tight tolerances."""
    case, far = count.case, np.inf
    bounds = (-far, far) if case.bounds is None else tuple(np.array(case.bounds).T)
    least_squares(
        lambda x: count.value(tensor(x)).numpy(),
        np.array(case.start),
        jac=lambda x: count.jacobian(tensor(x)).numpy(),  # pyright: ignore[reportArgumentType]
        bounds=bounds,
        method=method,
        x_scale="jac",
        loss="linear" if case.scale is None else "cauchy",
        f_scale=case.scale or 1.0,
        ftol=1e-12,
        xtol=1e-12,
        gtol=1e-12,
        max_nfev=POLICY.iterations,
    )


METHODS: dict[str, Callable[[Count], None]] = {
    "cgwm": ours,
    "acceleration": accelerated,
    "dogleg": dogleg,
    "trf": lambda count: by_scipy(count, "trf"),
    "dogbox": lambda count: by_scipy(count, "dogbox"),
    "lm": lambda count: by_scipy(count, "lm"),
}


def rosenbrock(x: Tensor) -> Tensor:
    """Return the residuals of Rosenbrock's valley (More, Garbow & Hillstrom 1981, problem 1)."""
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def powell_singular(x: Tensor) -> Tensor:
    """Return the residuals of Powell's function with a singular Jacobian at the minimum (problem 13)."""
    return torch.stack([x[0] + 10 * x[1], 5**0.5 * (x[2] - x[3]), (x[1] - 2 * x[2]) ** 2, 10**0.5 * (x[0] - x[3]) ** 2])


def beale(x: Tensor) -> Tensor:
    """Return the residuals of Beale's function (problem 5)."""
    return tensor([1.5, 2.25, 2.625]) - x[0] * (1 - x[1] ** torch.arange(1, 4))


def brown(x: Tensor) -> Tensor:
    """Return the residuals of Brown's badly scaled function (problem 4)."""
    return torch.stack([x[0] - 1e6, x[1] - 2e-6, x[0] * x[1] - 2])


def rank_one(x: Tensor) -> Tensor:
    """Return the residuals of a linear function of rank one (problem 33 with n = 5, m = 10); minimum m (m-1)/(4m+2)."""
    return torch.arange(1, 11) * (torch.arange(1, 6) * x).sum() - 1


def decay(seed: int = 0) -> Residuals:
    """Return the residuals of an exponential with 20 measurements in sigmas, five of them far off."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 4, 20)
    y = 3 * np.exp(-0.8 * t) + 0.5 + 0.02 * rng.standard_normal(20)
    y[[2, 7, 11, 12, 18]] += rng.uniform(0.5, 3, 5)
    times, seen = tensor(t), tensor(y)
    return lambda x: (x[0] * torch.exp(-x[1] * times) + x[2] - seen) / 0.02


def bundle(seed: int = 1) -> tuple[Residuals, tuple[float, ...]]:
    """Return residuals of 4 cameras on a circle (angle, height) that see 12 points (x, y, z), and a start.

    The measurements are exact; two points are held by their measured places.
    """
    rng = np.random.default_rng(seed)
    points, angles, heights = (
        rng.uniform(-1, 1, (12, 3)),
        np.array([0.0, 0.7, 1.6, 2.4]),
        np.array([0.0, 0.4, -0.3, 0.2]),
    )

    def seen(x: Tensor) -> Tensor:
        turn, height, place = x[:4, None], x[4:8, None], x[8:].view(12, 3)
        across = place[:, 0] * torch.cos(turn) + place[:, 1] * torch.sin(turn)
        depth = 5 - place[:, 0] * torch.sin(turn) + place[:, 1] * torch.cos(turn)
        return torch.cat([(across / depth).flatten(), ((place[:, 2] - height) / depth).flatten(), x[8:14]])

    truth = np.concatenate([angles, heights, points.ravel()])
    measured = seen(tensor(truth))
    return lambda x: 100 * (seen(x) - measured), tuple(truth + 0.3 * rng.standard_normal(len(truth)))


def toss() -> Residuals | None:
    """Return residuals [sigma] of the first frames of a real toss by place, velocity, turn and spin (12).

    A cube has the inertia of a sphere: it spins uniformly. Sigmas are 0.5 mm and 5 mrad. None without the data.
    """
    data = shared_data()
    source = None if data is None else data / "cube_tosses" / "cube_tosses_si.npz"
    if source is None or not source.exists():
        return None
    with np.load(source) as file:
        first = int(file["offsets"][0])
        place, quat = (tensor(file[name][first : first + FRAMES]) for name in ("pos", "quat_wxyz"))
        times = torch.arange(FRAMES) / float(file["rate_hz"])
    fall = tensor([0.0, 0.0, -9.81])

    def residuals(x: Tensor) -> Tensor:
        moved = x[:3] + x[3:6] * times[:, None] + 0.5 * fall * times[:, None] ** 2
        turn = quat_multiply(quat_multiply(quat[:1], quat_exp(x[None, 6:9])), quat_exp(x[9:12] * times[:, None]))
        wrong = quat_log(quat_multiply(quat_conjugate(quat), turn))
        return torch.cat([((moved - place) / 5e-4).flatten(), (wrong / 5e-3).flatten()])

    return residuals


def cases() -> list[Case]:
    """Return the problems; see `DECAY_MINIMUM` for the minima without a closed form."""
    arrow, start = bundle()
    tossed = toss()
    found = [
        Case(name="Rosenbrock", residuals=rosenbrock, start=(-1.2, 1.0), minimum=0.0),
        Case(name="Powell, singular", residuals=powell_singular, start=(3.0, -1.0, 0.0, 1.0), minimum=0.0),
        Case(name="Beale", residuals=beale, start=(1.0, 1.0), minimum=0.0),
        Case(name="Brown, badly scaled", residuals=brown, start=(1.0, 1.0), minimum=0.0),
        Case(
            name="Rosenbrock, x <= 0.5",
            residuals=rosenbrock,
            start=(-1.2, 1.0),
            minimum=0.25,
            bounds=((-2.0, 0.5), (-2.0, 2.0)),
        ),
        Case(name="linear, rank 1", residuals=rank_one, start=(1.0,) * 5, minimum=10 * 9 / 42),
        Case(name="decay, outliers", residuals=decay(), start=(1.0, 0.2, 0.0), minimum=DECAY_MINIMUM, scale=2.0),
        Case(name="cameras and points", residuals=arrow, start=start, minimum=0.0),
    ]
    if tossed is not None:
        found.append(
            Case(
                name="real toss", residuals=tossed, start=(*(0.0,) * 6, *(0.8,) * 3, *(5.0,) * 3), minimum=TOSS_MINIMUM
            )
        )
    return found


def solve(case: Case) -> dict[str, Count | None]:
    """Return what each method computed for a problem; None for a method that does not apply."""
    results: dict[str, Count | None] = {}
    for name, method in METHODS.items():
        applies = case.bounds is None or name not in ("dogleg", "lm")
        applies = applies and not (name == "lm" and case.scale is not None)
        applies = applies and not (name == "lm" and len(case.residuals(tensor(case.start))) < len(case.start))
        results[name] = Count(case=case) if applies else None
        if applies:
            method(results[name])  # pyright: ignore[reportArgumentType]
    return results


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    torch.set_num_threads(1)
    print("| problem | " + " | ".join(METHODS) + " |")
    print("| --- |" + " --- |" * len(METHODS))
    for case in cases():
        found = solve(case)
        print(f"| {case.name} | " + " | ".join("n/a" if one is None else one.text() for one in found.values()) + " |")


if __name__ == "__main__":
    main()
