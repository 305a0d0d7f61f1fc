"""Prediction errors in unseen episodes, and their ratio between two models, with an interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ...datasets.capture.capture import Capture
from ...datasets.capture.tracks import Episode
from ...datasets.models.model import Model
from ...schemas import ErrorRatio, FileModel
from ..compare.paired_difference import LEAST_EPISODES, RESAMPLES
from ..compare.short_horizon_errors import DIVERGED
from ..diagnose.evidence.cross_validation import continued
from ..optimization.tails import student_quantile
from ..physics.model_world import world_of_model
from ..physics.observation_model import measure
from ..physics.world import World
from ..runtime.resources import one_torch_thread
from ..segments.prepare import Prepared, prepare
from ..segments.random_effects import with_fitted_groups
from ..segments.release_detection import after_release
from ..segments.segment_states import fit_states
from ..segments.segments import Kind, Segments
from ..segments.sliding.support import on_surfaces
from ..trajectories.frame_times import episodes_at_clock
from ..trajectories.initial_state import estimate_states, warmup_frames
from ..trajectories.observations import Observations
from ..trajectories.segmentation import Segment, whole_episodes

WARMUP_S, WARMUP_ITERATIONS = 0.1, 5
"""Start of a roll from which the rest of it is predicted [s], and maximum number of steps of the fit to it."""
LEAST_FOR_STUDENT = 3
"""Minimum number of episodes for an interval by Student's t, which assumes normal logarithms of the ratios."""


class HeldOutErrors(FileModel):
    """Typical prediction errors by episode, in units of the measurement noise; without those that have no such part."""

    flight: dict[str, float]
    contact: dict[str, float]
    failure: str = ""
    """The message of a fit that failed."""

    def joined(self, other: HeldOutErrors) -> HeldOutErrors:
        """Return the errors of these episodes and of others."""
        return HeldOutErrors(flight=self.flight | other.flight, contact=self.contact | other.contact)


@one_torch_thread()
def prepared_episodes(model: Model, capture: Capture, names: Sequence[str]) -> tuple[list[Episode], Prepared]:
    """Return episodes and their segments, which are the same for all models that are compared on them."""
    world, given = world_of_model(model), capture.manifest.measurement
    episodes, _ = episodes_at_clock(capture, names, [world.bodies[k].name for k in world.tracked])
    return episodes, prepare(world, episodes, (given.position_std_m, given.rotation_std_rad))


@one_torch_thread()
def typical_errors(model: Model, capture: Capture, episodes: Sequence[Episode], prepared: Prepared) -> HeldOutErrors:
    """Return the typical prediction errors of each episode, in units of the measurement noise.

    The state of a segment of flight or contact is fitted to its first half, and the second half is predicted; on fixed
    surfaces that of a whole episode to its start.
    Parameters that differ from episode to episode are fitted to these, with the spread that the model's fit has found.

    Args:
        model: A model that was not fitted to the episodes.
        capture: The capture, for the groups of its episodes.
        episodes: Name and tracks by body of each episode.
        prepared: The same episodes, cut into segments.
    """
    world = world_of_model(model)
    flown = after_release(episodes, prepared.released_s)
    world = with_fitted_groups(world, flown, model.file, capture.groups, prepared.noise)
    whole = replace(
        whole_episodes(world, episodes),
        seen=prepared.observations.seen,
        has_orientation=prepared.observations.has_orientation,
        time_shift=prepared.observations.time_shift,
    )
    if on_surfaces(world):
        return HeldOutErrors(flight={}, contact=_open_loop_errors(world, whole, prepared))
    errors: dict[str, dict[str, float]] = {}
    kinds: tuple[tuple[Kind, Sequence[Segment]], ...] = (
        ("flight", () if prepared.flight is None else prepared.flight.items),
        ("contact", prepared.contact_items),
    )
    for kind, items in kinds:
        if items:
            segments = fit_states(Segments.of(kind, world, whole, items, prepared.noise))
            squares: dict[str, list[Tensor]] = {}
            for item, mean in zip(items, _late_squares(segments), strict=True):
                squares.setdefault(episodes[item.episode].name, []).append(mean)
            joined = {name: torch.cat(values) for name, values in squares.items()}
            errors[kind] = {name: typical_error(values) for name, values in joined.items() if len(values)}
    return HeldOutErrors(flight=errors.get("flight", {}), contact=errors.get("contact", {}))


def _open_loop_errors(world: World, whole: Observations, prepared: Prepared) -> dict[str, float]:
    """Return the typical errors of whole rolls and slides on fixed surfaces, predicted from their starts.

    What a short piece leaves of a resistance or a tilt is far below the noise.
    """
    warm = warmup_frames(world, whole, WARMUP_S)
    begun, _ = estimate_states(world, whole, warm, prepared.noise, WARMUP_ITERATIONS)
    columns = list(begun.free)
    with torch.no_grad():
        found = measure(begun.world(world), begun.state, begun.times_s, begun.drives).position_m[:, :, columns]
    rows = torch.nan_to_num((found - begun.position_m) / prepared.noise.position_m, nan=DIVERGED, posinf=DIVERGED)
    square = rows.square().mean(-1)[..., 0]
    late = (begun.seen[..., 0] > 0) & ~warm
    return {name: typical_error(square[k][late[k]]) for k, name in enumerate(begun.names) if bool(late[k].any())}


def _late_squares(segments: Segments) -> list[Tensor]:
    """Return the mean square errors of the predicted frames of each segment, in units of the noise."""
    nothing = torch.zeros(0).to(segments.world.gravity)
    fitted, late = continued(segments, [], nothing)
    seen = segments.observations
    rows = fitted.residuals((), nothing, jacobian=False)[0].unflatten(1, (late.shape[1], -1))
    rows = torch.nan_to_num(rows, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED)
    position = seen.seen[..., None] * seen.measured_axes[:, None]
    known = torch.cat((position, seen.has_orientation[..., None].expand(-1, -1, -1, 3)), -1) * late[..., None]
    square, count = (known * rows**2).sum((2, 3)), known.sum((2, 3))
    return [(square[k] / count[k].clamp_min(1.0))[count[k] > 0] for k in range(len(segments.items))]


def typical_error(squares: Tensor) -> float:
    """Return the typical error of frames with mean square errors (F,) in units of the noise.

    It is the mean on the scale of log(1 + s^2): a few impacts do not outweigh a long flight, and differences far below
    the noise count as nothing.

    >>> round(typical_error(torch.tensor([9.0, 9.0])), 6)
    3.0
    """
    return float(torch.log1p(squares).mean().expm1().sqrt())


def error_ratio(before: Mapping[str, float], after: Mapping[str, float]) -> ErrorRatio | None:
    """Return the ratio of the errors of two models on the episodes that both have; None without any.

    The interval is the percentile bootstrap over episodes (Efron 1979) of the mean logarithm of the ratio; for fewer
    than `LEAST_EPISODES`, where it is too short, that of Student's t.
    """
    shared = [name for name in before if name in after and before[name] > 0 and after[name] > 0]
    if not shared:
        return None
    first, second = (np.array([errors[name] for name in shared]) for errors in (before, after))
    change = np.log(second / first)
    interval = None
    if len(change) >= LEAST_EPISODES:
        draws = np.random.default_rng(0).integers(0, len(change), (RESAMPLES, len(change)))
        low, high = np.percentile(change[draws].mean(axis=1), (2.5, 97.5))
        interval = (float(np.exp(low)), float(np.exp(high)))
    elif len(change) >= LEAST_FOR_STUDENT:
        half = student_quantile(0.975, len(change) - 1) * float(change.std(ddof=1)) / len(change) ** 0.5
        interval = (float(np.exp(change.mean() - half)), float(np.exp(change.mean() + half)))
    return ErrorRatio(
        episodes=len(change),
        better=int((change < 0).sum()),
        before=float(np.median(first)),
        after=float(np.median(second)),
        ratio=float(np.exp(change.mean())),
        interval_95=interval,
    )
