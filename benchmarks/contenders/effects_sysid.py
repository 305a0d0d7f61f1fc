"""System identification in MuJoCo: each candidate is fitted to the rollouts, and a likelihood-ratio test decides.

`mujoco.sysid` (MuJoCo 3.17) identifies parameters of an MJCF model; lift by spin, winds, tilts of a frame, clocks and
most others are none, and its optimiser is scipy's. So the rollouts of `effects_windows` are fitted with
`scipy.optimize.least_squares` for every candidate alike, states and contact projected out (Kaufman 1975). Errors of
neighbouring frames are correlated: the number of frames in the test is divided by their correlation time, which is what
keeps this test from naming something everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2

from .effects_base import Named
from .effects_bic import squares_of
from .effects_formulas import LIBRARY, Array
from .effects_windows import Bench, Linear, fitted

LEVEL = 0.01
"""Of all candidates together (Bonferroni)."""
SHORTLIST, MOST, NEARLY = 3, 2, 6.0


class MujocoSysid:
    """Likelihood-ratio tests of fits in MuJoCo."""

    name: str = "sysid"

    def missing(self) -> str | None:
        """Return None: it needs MuJoCo, which the package needs itself."""
        return None

    def names(self, capture: Path) -> Named:
        """Return the effects whose fits are better than chance, one after the other."""
        bench = Bench(capture)
        linear = fitted(bench)
        chosen: list[str] = []
        aliases: list[tuple[str, ...]] = []
        before, frames = float(linear.errors @ linear.errors), _independent(linear)
        details = {"frames": len(linear.errors), "independent": frames}
        while len(chosen) < MOST:
            listed = [name for name in LIBRARY if name not in chosen]
            listed = sorted(listed, key=lambda name: squares_of(linear, [*chosen, name])[0])[:SHORTLIST]
            after = {name: _fit(bench, linear, [*chosen, name]) for name in listed}
            gain = {name: frames * float(np.log(before / max(after[name], 1e-9))) for name in listed}
            name = min(listed, key=lambda one: chi2.sf(gain[one], len(LIBRARY[one])) - 1e-9 * gain[one])
            if chi2.sf(gain[name], len(LIBRARY[name])) * len(LIBRARY) > LEVEL:
                break
            chosen.append(name)
            near = [one for one in listed if one != name and gain[one] > gain[name] - NEARLY]
            aliases.append((name, *near))
            before = after[name]
        return Named(named=tuple(chosen), aliases=tuple(aliases), details=details)


def _fit(bench: Bench, linear: Linear, names: Sequence[str]) -> float:
    """Return the sum of squares of a fit with effects, from the linear solution on."""
    columns = np.hstack([linear.columns[name] for name in names])
    steps = np.concatenate([LIBRARY[name] for name in names])
    start = np.linalg.lstsq(columns * steps, linear.errors, rcond=1e-6)[0]

    def errors(values: Array) -> Array:
        scaled, place, own = values * steps, 0, {}
        for name in names:
            own[name] = scaled[place : place + len(LIBRARY[name])]
            place += len(LIBRARY[name])
        parts = []
        for window, basis in zip(linear.kept, linear.states, strict=True):
            one = bench.weighted(window, bench.predict(window, window.state, bench.contact, own))
            parts.append(one - basis @ (basis.T @ one))
        every = np.nan_to_num(np.concatenate(parts), nan=1e3, posinf=1e3, neginf=-1e3)
        return every - linear.contact @ (linear.contact.T @ every)

    begin = min((np.zeros_like(start), start), key=lambda values: float((errors(values) ** 2).sum()))
    found = least_squares(errors, begin, max_nfev=3, diff_step=1e-2, x_scale=np.maximum(np.abs(begin), 1.0))
    return float(2 * found.cost)


def _independent(linear: Linear) -> float:
    """Return how many independent errors there are: the number over their correlation time (AR(1))."""
    together, apart, place = 0.0, 0.0, 0
    for window, basis in zip(linear.kept, linear.states, strict=True):
        rows = linear.errors[place : place + len(basis)].reshape(len(window.times_s), -1)
        place += len(basis)
        together += float((rows[1:] * rows[:-1]).sum())
        apart += float((rows[1:] ** 2).sum() + (rows[:-1] ** 2).sum()) / 2
    share = float(np.clip(together / max(apart, 1e-12), 0.0, 0.98))
    return max(len(linear.errors) - linear.counted, 10) * (1 - share) / (1 + share)
