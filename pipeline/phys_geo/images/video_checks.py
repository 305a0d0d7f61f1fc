"""Checks of videos before a fit: whether they contain information on contact, and agree with the model.

Before the poses are found, the images alone are checked (`examine_videos`). Afterwards it is checked whether the bodies
move, and whether they start inside an obstacle (`examine_tracks`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ....datasets.capture.capture import Capture
from ....datasets.capture.tracks import Episode, Track
from ....schemas import InputDataError
from ...physics.checks import overlaps
from ...physics.world import World
from ...trajectories.observations import Observations
from ...trajectories.track_noise import Noise
from ..tracks.contact_fit import MAX_SPAN_S
from .video_frames import Footage, Video, load_footage

SIZE_PX = 144
"""Longer side of the compared images [px]."""
CHANGE_FLOOR, CHANGE_FACTOR = 0.03, 6.0
"""Minimum difference of a changed pixel, as a share of the brightness range, and as a multiple of the median
difference."""
MIN_CHANGED_PX = 6
"""Minimum number of changed pixels for motion [px]; an edge of a moving body has more."""
STILL_SIGMA = 6.0
"""Maximum distance from the first pose of a body at rest, in standard errors; twenty poses scatter by four."""
MOVED_SHARE, MOVED_RAD = 0.25, 0.5
"""Shift, as a share of a body's size, and rotation [rad] that count as motion for any uncertainty of the poses."""
DEEP_M, DEEP_SIGMA = 0.002, 3.0
"""Maximum depth of a start inside an obstacle [m], to which this number of standard errors of its position is added."""
REFUSED_SHARE = 0.1
"""Additional depth above which a start is refused, as a share of the free body's radius; the contact would throw the
body."""

"""Standard deviations of a track: position [m], rotation [rad]."""


def examine_videos(capture: Capture, split: str, tracks_too: bool) -> list[str]:
    """Check the videos of a split before the fit, and return warnings about them.

    Args:
        capture: The capture.
        split: Name of the episodes.
        tracks_too: Whether episodes with tracks of a free body may lack a video.

    Raises:
        InputDataError: If a video cannot be used (see :func:`load_footage`), or nothing moves in any of them.
    """
    free = {body.name for body in capture.manifest.bodies if body.motion == "free"}
    if not free:
        return []  # the fit of the physics reports this
    warnings, still, moving = [], [], 0
    for name in capture.episodes(split):
        if tracks_too and free & set(capture.tracks(name)):
            moving += 1
            if not capture.videos(name):
                continue
        footage = load_footage(capture, name, SIZE_PX)
        warnings += _unseen(footage)
        if _still(footage):
            still.append(name)
        else:
            moving += 1
    if still and not moving:
        raise _nothing_moves(capture, split, still)
    return warnings + [f"{name}: nothing moves in its videos; it contains no information on contact." for name in still]


def _still(footage: Footage) -> bool:
    """Return whether nothing moves in any video of an episode; False if a camera moves."""
    changed = [_most_changed(video) for video in footage.videos]
    return all(count is not None and count < MIN_CHANGED_PX for count in changed)


def _nothing_moves(capture: Capture, split: str, still: Sequence[str]) -> InputDataError:
    """Return the error for a split in whose episodes nothing moves."""
    which = f"episode '{still[0]}'" if len(still) == 1 else f"any of the {len(still)} episodes of split '{split}'"
    return InputDataError(
        f"{capture.root / 'videos'}: nothing moves in {which}: in the first {MAX_SPAN_S:g} s, which are fitted, "
        f"fewer than {MIN_CHANGED_PX} pixels change (of images {SIZE_PX} px long, by {CHANGE_FLOOR:.0%} of the "
        "brightness).",
        "a motion with contact: a drop, a throw or a push. A body at rest shows no friction, stiffness or damping.",
        f"film the motion, or begin where it begins: [episodes] '{still[0]}' = {{ start_s = ... }}.",
    )


def examine_tracks(world: World, episodes: Sequence[tuple[str, Mapping[str, Track], Noise]]) -> list[str]:
    """Check the tracks before the fit, and return warnings about them.

    Args:
        world: The bodies, and the ground of the capture.
        episodes: Name, tracks by body and their noise of each episode.

    Raises:
        InputDataError: If no body moves in any episode, or a body starts deep inside another or the ground.
    """
    if not any(_moves(world, tracks, noise) for _, tracks, noise in episodes):
        free = [world.bodies[index].name for index in world.free]
        largest = max(_largest_shift(tracks[name]) for _, tracks, _ in episodes for name in free if name in tracks)
        raise InputDataError(
            f"no free body moves in any of the {len(episodes)} episode(s): at most by {1e3 * largest:.2f} mm, which "
            f"the noise of its poses explains ({1e3 * episodes[0][2][0]:.2f} mm).",
            "a motion with contact: a drop, a throw or a push. A body at rest shows no friction, stiffness or damping.",
            "film the motion; if the body does move, check that the masks and the cameras are those of these videos.",
        )
    return [text for name, tracks, noise in episodes for text in _overlap(world, name, tracks, noise)]


def _unseen(footage: Footage) -> list[str]:
    """Return warnings about frames whose masks lack a free body."""
    texts = []
    for video in footage.videos:
        if video.unseen is None:
            continue
        numbers = np.flatnonzero(video.unseen)
        listed = ", ".join(map(str, numbers[:8])) + (", ..." if len(numbers) > 8 else "")
        texts.append(
            f"{footage.episode}: {video.camera}: the masks of {len(numbers)} of {len(video.unseen)} frames show no "
            f"body that moves freely (frames {listed}); they count as not seen."
        )
    every = np.unique(np.concatenate([video.times_s for video in footage.videos]))
    lost = [time for time in every if np.abs(footage.times_s - time).min() > 1e-6]
    if lost:
        texts.append(
            f"{footage.episode}: no camera shows the body in {len(lost)} of {len(every)} instants, from "
            f"{lost[0]:.3f} s to {lost[-1]:.3f} s; they carry no information."
        )
    return texts


def _most_changed(video: Video) -> int | None:
    """Return the maximum number of pixels in which a frame differs from the first; None if the camera moves."""
    if len(np.unique(video.viewmats.cpu().numpy(), axis=0)) > 1:
        return None
    frames = video.frames.cpu().numpy()[video.times_s <= video.times_s[0] + MAX_SPAN_S + 1e-9]
    return max(_changed(frames[0], frame) for frame in frames[1:])


def _changed(before: NDArray[np.float32], after: NDArray[np.float32]) -> int:
    """Return the number of changed pixels between frames (H, W, 3), whose exposure may differ."""
    a, b = (cv2.blur(frame, (3, 3)).astype(np.float64) for frame in (before, after))
    gain = np.median((a + 0.05) / (b + 0.05), axis=(0, 1))
    difference = np.abs(a - gain * b).mean(-1)
    return int((difference > max(CHANGE_FLOOR, CHANGE_FACTOR * float(np.median(difference)))).sum())


def _moves(world: World, tracks: Mapping[str, Track], noise: Noise) -> bool:
    """Return whether any free body leaves its first pose by more than the noise, or by a share of its size."""
    for index in world.free:
        body = world.bodies[index]
        track = tracks.get(body.name)
        if track is None:
            continue
        size = float((body.centers[0] - body.com[0]).norm(dim=-1).mean() + body.radii[0].mean())
        far = min(STILL_SIGMA * math.sqrt(3) * noise.position_m, MOVED_SHARE * size)
        turned = min(STILL_SIGMA * math.sqrt(3) * noise.rotation_rad, MOVED_RAD)
        if _largest_shift(track) > far or _largest_turn(track) > turned:
            return True
    return False


def _largest_shift(track: Track) -> float:
    """Return the maximum distance of a track from its first position [m]."""
    return float(np.linalg.norm(track.position_m - track.position_m[0], axis=1).max())


def _largest_turn(track: Track) -> float:
    """Return the maximum angle of a track from its first orientation [rad]; 0 without orientations."""
    if track.quat_wxyz is None:
        return 0.0
    return float(2 * np.arccos(np.abs(track.quat_wxyz @ track.quat_wxyz[0]).clip(max=1.0)).max())


def _overlap(world: World, name: str, tracks: Mapping[str, Track], noise: Noise) -> list[str]:
    """Return warnings about bodies that start inside an obstacle, and refuse a body deep inside one."""
    free = [tracks[world.bodies[i].name] for i in world.free if world.bodies[i].name in tracks]
    times = np.unique(np.concatenate([track.time_s for track in free]))
    first = Observations.of(world, [Episode(name, dict(tracks))], [(float(times[0]) - 1e-9, float(times[1]) + 1e-9)])
    state = first.state
    for index, body in enumerate(world.bodies):
        if body.name in first.drives:
            pose = first.drives[body.name].at(first.times_s[:, 0])
            state.position_m[:, index], state.quat_wxyz[:, index] = pose.com, pose.quat_wxyz
    reach = {b.name: float(((b.centers[0] - b.com[0]).norm(dim=-1) + b.radii[0]).max()) for b in world.bodies}
    texts = []
    for overlap in overlaps(world, state):
        depth, allowed = float(overlap.depth_m[0]), DEEP_M + DEEP_SIGMA * noise.position_m
        if depth <= allowed:
            continue
        found = f"{name}: in the first frame body '{overlap.body}' is {1e3 * depth:.1f} mm deep inside {overlap.other}"
        if depth <= allowed + REFUSED_SHARE * reach[overlap.body]:
            texts.append(f"{found}; the fit starts with a contact force that did not act on the body.")
            continue
        raise InputDataError(
            f"{found}, which is impossible for rigid bodies: the ground, the scale, the shape or the poses are wrong, "
            "or an object that is not in the capture pressed the body there.",
            f"up to {1e3 * allowed:.1f} mm (with the poses' noise of {1e3 * noise.position_m:.1f} mm).",
            "check [world] ground's offset_m and normal, the metric scale of the cameras (cgwm validate), the size of "
            "the shape, and a driven body's track; or begin a little later ([episodes] start_s).",
        )
    return texts
