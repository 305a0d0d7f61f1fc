"""One model of a comparison: open-loop predictions, short predictions in units of the noise, and their figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...datasets.models.model import Model
from ...schemas import PHASES, CovariateShare, ModelComparison, Phase, PhaseFigures, WorstMoment
from ..evaluate.evaluation import Evaluation
from ..trajectories.track_noise import Noise
from .residual_wrenches import WrenchPoint
from .short_horizon_errors import FREEDOMS, ShortErrors

Array = NDArray[np.float64]

WORST = 12
"""Number of the worst moments that are listed for a model."""
LEAST_FREEDOM = 6.0
"""Minimum number of degrees of freedom for a reduced chi-square of a phase."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ComparedModel:
    """A model with its predictions, their errors and its residual wrenches."""

    name: str
    """Name as the user gave it."""
    short_name: str
    """Name on the page."""
    model: Model
    """The model."""
    evaluation: Evaluation
    """The open-loop evaluation."""
    noise: Noise
    """Standard deviations of the measurement that scale short predictions (position [m], rotation [rad])."""
    short: Mapping[str, ShortErrors] = field(default_factory=dict)
    """Short predictions by episode."""
    wrenches: Sequence[WrenchPoint] = ()
    """Residual wrenches and misfits of the segments."""
    covariates: Sequence[CovariateShare] = ()
    """Coordinates that explain the residual wrench in flight."""

    @property
    def errors_m(self) -> dict[str, float]:
        """Translation error by episode [m]."""
        return {e.episode: e.translation_error_m for e in self.evaluation.result.per_episode}

    def figures(self) -> ModelComparison:
        """Return the figures of the model that `--json` prints."""
        result = self.evaluation.result
        everything = _figures(list(self.short.values()), None, self.noise)
        return ModelComparison(
            model=self.name,
            effects=tuple(effect.name for effect in self.model.file.effects),
            translation_error_m=result.translation_error_m,
            rotation_error_deg=result.rotation_error_deg,
            psnr_db=result.psnr_db,
            psnr_object_db=result.psnr_object_db,
            ssim=result.ssim,
            state_fitted_residual_m=result.state_fitted_residual_m,
            state_noise_floor_m=result.state_noise_floor_m,
            baselines=result.baselines,
            reduced_chi2=None if everything is None else everything.reduced_chi2,
            by_phase={phase: _figures(list(self.short.values()), phase, self.noise) for phase in PHASES},
            worst=tuple(_worst(self.short.values())),
            wrench=tuple(self.covariates),
            per_episode=result.per_episode,
            warnings=result.warnings,
        )

    def episode_chi2(self, episode: str) -> float | None:
        """Return the reduced chi-square of the short predictions of one episode; None where there are none."""
        found = self.short.get(episode)
        figures = None if found is None else _figures([found], None, self.noise)
        return None if figures is None else figures.reduced_chi2


def _figures(short: Sequence[ShortErrors], phase: Phase | None, noise: Noise) -> PhaseFigures | None:
    """Return the figures of one phase, or of all phases; None if it has no frame.

    Flight includes only segments without contact, because the misfit of a contact segment spreads to its frames in
    flight.
    """
    sigmas, freedom = [], []
    for one in short:
        inside = np.isfinite(one.sigmas).any(-1)
        if phase is not None:
            place = PHASES.index(phase)
            within = (one.phase == place) & ((phase != "flight") | (one.cause == place))
            inside &= within[:, None]
        sigmas.append(one.sigmas[inside])
        freedom.append(one.freedom[inside])
    rows = np.concatenate(sigmas) if sigmas else np.zeros((0, 6))
    if len(rows) == 0:
        return None
    left = np.concatenate(freedom)
    known = np.isfinite(rows)
    square = np.where(known, rows, 0.0) ** 2
    total = float(np.where(known, left, 0.0).sum())
    count = known.sum(0)
    mean = np.where(count > 0, square.sum(0) / np.maximum(count, 1), np.nan)
    turned = known[:, 3:].any()
    return PhaseFigures(
        frames=len(rows),
        reduced_chi2=float(square.sum()) / total if total >= LEAST_FREEDOM else None,
        position_rms_m=float(np.sqrt(np.nansum(mean[:3]))) * noise.position_m,
        rotation_rms_deg=float(np.degrees(np.sqrt(mean[3:].sum()) * noise.rotation_rad)) if turned else None,
        sigmas={name: float(np.sqrt(mean[k])) for k, name in enumerate(FREEDOMS) if np.isfinite(mean[k])},
    )


def _worst(short: Iterable[ShortErrors]) -> list[WorstMoment]:
    """Return the segments with the largest residuals, the worst first."""
    found: list[WorstMoment] = []
    for one in short:
        size = np.where(np.isfinite(one.sigmas), np.abs(one.sigmas), -1.0)
        for span in np.unique(one.span_s[np.isfinite(one.span_s).all(1)], axis=0):
            rows = np.flatnonzero((one.span_s == span).all(1))
            frame, body, freedom = np.unravel_index(int(size[rows].argmax()), size[rows].shape)
            at = rows[frame]
            if size[at, body, freedom] < 0 or one.cause[at] < 0:
                continue
            start, end = (round(float(t - one.time_s[0]), 6) for t in span)
            found.append(
                WorstMoment(
                    episode=one.episode,
                    t0_s=start,
                    t1_s=end,
                    phase=one.phase_name(int(one.cause[at])),
                    quantity=f"{one.bodies[body]} {FREEDOMS[freedom]}",
                    z=float(size[at, body, freedom]),
                )
            )
    return sorted(found, key=lambda moment: -moment.z)[:WORST]
