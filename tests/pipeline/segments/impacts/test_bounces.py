"""Bounces against a ball whose hops are parabolas between known times."""

import numpy as np
import pytest
from cgwm.pipeline.segments.impacts.bounces import LIMITS, BounceSide, bounces_in

IMPACTS_S = (0.1, 0.35, 0.5503)
SPEEDS_M_S = (1.5, 0.9, 0.7)
GRAVITY_M_S2 = 9.81


def hopping(rate_hz: float, end_s: float = 0.62) -> BounceSide:
    """Return frames of a ball that falls from rest, hops twice and once more, of which only the beginning is seen."""
    time = np.arange(0.0, end_s, 1 / rate_hz)
    height = np.where(time < IMPACTS_S[0], 0.5 * GRAVITY_M_S2 * (IMPACTS_S[0] ** 2 - time**2) + 0.4 * (0.1 - time), 0.0)
    for begin, stop in zip(IMPACTS_S, (*IMPACTS_S[1:], 1.0), strict=True):
        inside, since = (time >= begin) & (time < stop), time - begin
        flight = (stop - begin) if stop < 1.0 else 2 * SPEEDS_M_S[-1] / GRAVITY_M_S2
        height = np.where(inside, 0.5 * GRAVITY_M_S2 * since * (flight - since), height)
    return BounceSide(time_s=time, height_m=height, position_m=np.outer(height, [0.0, 0.5, 1.0]))


@pytest.mark.parametrize("rate_hz", [1000.0, 200.0])
def test_each_bounce_has_the_frames_of_its_two_flights_that_no_contact_may_hold(rate_hz: float) -> None:
    frames = hopping(rate_hz)
    found = list(bounces_in(7, frames, 9.81))
    turns = [frames.time_s[np.abs(frames.time_s - at).argmin()] for at in IMPACTS_S]
    assert len(found) == 3 and {bounce.episode for bounce in found} == {7}
    clear = np.all([np.abs(frames.time_s - turn) > LIMITS.apart_s for turn in turns], axis=0)
    for place, (bounce, turn) in enumerate(zip(found, turns, strict=True)):
        begin = turns[place - 1] if place else -np.inf
        end = turns[place + 1] if place + 1 < len(turns) else np.inf
        since = frames.time_s - turn
        for side, rows in (
            (bounce.before, clear & (frames.time_s > begin) & (since < 0) & (since > -LIMITS.longest_s)),
            (bounce.after, clear & (frames.time_s < end) & (since > 0) & (since < LIMITS.longest_s)),
        ):
            np.testing.assert_allclose(side.time_s, since[rows], atol=1e-12)
            np.testing.assert_array_equal(side.height_m, frames.height_m[rows])
            np.testing.assert_array_equal(side.position_m, frames.position_m[rows])


def test_a_bounce_needs_four_frames_on_each_side() -> None:
    frames = hopping(200.0)
    bounce = next(bounces_in(0, frames, 9.81))
    early = float(bounce.before.time_s[LIMITS.least_frames])  # frames before it are kept
    kept = bounce.without((early, 0.02))
    assert kept is not None and len(kept.before) == LIMITS.least_frames
    assert float(kept.after.time_s[0]) == pytest.approx(0.025)
    assert bounce.without((float(bounce.before.time_s[LIMITS.least_frames - 1]), 0.02)) is None
    for count in (LIMITS.least_frames, LIMITS.least_frames - 1):  # frames of the last flight, beside that of the turn
        cut = frames.time_s < 0.5525 + 0.005 * count
        short = BounceSide(time_s=frames.time_s[cut], height_m=frames.height_m[cut], position_m=frames.position_m[cut])
        last = [len(each.after) for each in bounces_in(0, short, 9.81)][2:]
        assert last == ([count] if count == LIMITS.least_frames else [])
