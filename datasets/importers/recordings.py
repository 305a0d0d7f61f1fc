"""Common parts of the importers of tracks: recordings, their units, their split and the capture that is written."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from ...schemas import QUATERNION_NORM_TOLERANCE, Articulation, Body, CaptureManifest, InputDataError, World
from ...schemas.capture import Episode, Name
from ...schemas.imports import ImportResult
from ...schemas.regular_files import read_text_file, require_regular_file
from ..capture.files import entries_of
from ..capture.manifest import write_manifest
from ..capture.tracks import SHORTEST_STEP_S, Track, tracks_csv
from ..io.cells import LARGEST, shown
from ..io.progress import note, progress

Array = NDArray[np.float64]
LengthUnit = Literal["m", "cm", "mm", "in"]
TimeUnit = Literal["s", "ms", "us", "ns"]

LENGTHS_M: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
TIMES_S: dict[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SLOWEST_STEP_S, _LONGEST_PATH_M = 1.0, 100.0
"""Largest time step and largest extent of a path for which numbers without a unit count as seconds and metres."""
_FALL_S, _LIKE = 0.12, 0.45
"""Duration of a piece of motion whose acceleration is looked at, and its difference from gravity, as a logarithm, up to
which a unit is likely: less than half of the one between centimetres and inches."""
_STEADY = 5.0
"""Steps of a body that moves, in units of the smallest difference between two numbers of its track."""
FASTEST_RAD_S = 5000.0
"""Largest angular velocity [rad/s]: 50 000 turns a minute; larger ones are in degrees."""
_LONGEST_NAME = 150
"""Maximum length of the name of an episode, which becomes that of a file."""
_GAP_STEPS, _GAPS_NAMED = 1.75, 3
"""Time step, in usual ones, that is a gap; and maximum number of tracks with gaps that are named."""
_TRAIN_SHARE = 0.6
"""Default share of the episodes in the split "train"."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """One imported episode, before it is written to a capture."""

    name: str
    """Name of the episode."""
    tracks: dict[str, Track]
    """Tracks by body."""
    group: str | None = None
    """Session that it belongs to."""
    start_s: float | None = None
    """Time before which samples are ignored [s]."""
    end_s: float | None = None
    """Time after which samples are ignored [s]."""

    @property
    def entry(self) -> Episode:
        """Entry of the episode in the manifest."""
        return Episode(group=self.group, start_s=self.start_s, end_s=self.end_s)


@dataclass(frozen=True)
class Units:
    """The units of recorded numbers; None: metres and seconds, unless the numbers rule that out.

    Quaternions are normalised if their norm differs from 1 by no more than the tolerance.
    """

    length: LengthUnit | None = None
    """Unit of positions."""
    time: TimeUnit | None = None
    """Unit of times."""

    def track(
        self,
        where: str,
        time: Array,
        position: Array,
        quat_wxyz: Array | None = None,
        omega_rad_s: Array | None = None,
        force_n: Array | None = None,
    ) -> Track:
        """Return a track in metres and seconds, without a shift of its times.

        Samples without a finite position are omitted, as gaps are allowed; those at the ends are said here, gaps in the
        result of the import.

        Args:
            where: What the numbers come from, for messages.
            time: Shape (T,), in the unit of time.
            position: Shape (T, 3), in the unit of length.
            quat_wxyz: Shape (T, 4), or None for a centroid.
            omega_rad_s: Angular velocity [rad/s] in the frame of a track file, shape (T, 3), or None.
            force_n: Force that the body exerts on what it touches [N], world frame, shape (T, 3), or None; not finite
                in all samples where it was not measured at all.

        Raises:
            InputDataError: If fewer than two samples are left, times do not increase, are not finite or step so far
                that they are no seconds, positions spread so far that they are no metres, or quaternions are not unit.
        """
        _require_as_many(
            where, times=time, positions=position, orientations=quat_wxyz, spins=omega_rad_s, forces=force_n
        )
        seen = _with_a_pose(where, position, quat_wxyz)
        time, position = time[seen], position[seen]
        _require_times(where, time)
        self._require_likely(where, time, position)
        omega = None if omega_rad_s is None else _spin(where, omega_rad_s[seen])
        quat = None if quat_wxyz is None else _unit(where, quat_wxyz[seen])
        fresh = _not_repeated(where, position, quat)
        time, position, quat = time[fresh], position[fresh], None if quat is None else quat[fresh]
        omega, force_n = None if omega is None else omega[fresh], None if force_n is None else force_n[seen][fresh]
        track = Track(
            time * TIMES_S[self.time or "s"],
            position * LENGTHS_M[self.length or "m"],
            quat,
            omega_body_rad_s=omega,
            force_n=None if force_n is None else _force(where, force_n),
        )
        _require_in_range(where, track)
        return track

    def _require_likely(self, where: str, time: Array, position: Array) -> None:
        """Refuse numbers that are hardly seconds or metres where nobody said that they are."""
        step, spread = float(np.median(np.diff(time))), float(np.ptp(position, axis=0).max())
        if self.time is None and step >= _SLOWEST_STEP_S:
            raise _hardly_seconds(where, step)
        if self.length is None and spread > _LONGEST_PATH_M:
            raise InputDataError(
                f"{where}: positions spread over {spread:.6g}: hardly metres.",
                "metres, or another unit that is named.",
                f"add --length-unit {self._likely_length(time, position)} (or, if these are metres: --length-unit m).",
            )

    def _likely_length(self, time: Array, position: Array) -> str:
        """Return the unit of length in which the body falls as on Earth for most of the time; mm where in none."""
        frames = max(int(np.searchsorted(time - time[0], _FALL_S / TIMES_S[self.time or "s"])), 4)
        pieces = [slice(k, k + frames) for k in range(0, len(time) - frames + 1, frames)]
        if not pieces:
            return "mm"
        seconds = time * TIMES_S[self.time or "s"]
        bends = [np.polyfit(seconds[one] - seconds[one][0], position[one], 2)[0] for one in pieces]
        strength = 2 * float(np.median(np.linalg.norm(bends, axis=1)))
        fits = [unit for unit, metres in LENGTHS_M.items() if abs(np.log(max(strength * metres, 1e-9) / 9.81)) < _LIKE]
        return fits[0] if fits else "mm"


def _with_a_pose(where: str, position: Array, quat_wxyz: Array | None) -> NDArray[np.bool_]:
    """Return which samples (T,) have a pose, and say how many at the ends have none."""
    seen = np.asarray(np.isfinite(position).all(1))
    if quat_wxyz is not None:
        seen &= np.isfinite(quat_wxyz).all(1)
    known = np.flatnonzero(seen)
    if len(known) and (outside := len(seen) - (known[-1] - known[0] + 1)):  # gaps inside: `gap_warnings`
        note(f"{where}: {outside} samples before the first pose or after the last one are left out")
    return seen


def _not_repeated(where: str, position: Array, quat_wxyz: Array | None) -> NDArray[np.bool_]:
    """Return which samples (T,) are none that repeat the one before to the last digit while the body moves, and say so.

    A tracker that was late, or a file whose frame rate was doubled, repeats poses; the body did not stand still.
    """
    same = (np.diff(position, axis=0) == 0).all(1)
    if quat_wxyz is not None:
        same &= (np.diff(quat_wxyz, axis=0) == 0).all(1)
    fresh = np.append(True, ~same)
    steps = np.abs(np.diff(position[fresh], axis=0))
    if not same.any() or not steps.any():
        return np.ones(len(position), bool)
    digit = float(steps[steps > 0].min())
    size = np.linalg.norm(steps, axis=1)
    number = np.cumsum(fresh) - 1  # of the last fresh sample
    around = np.minimum(size[np.maximum(number - 1, 0).clip(max=len(size) - 1)], size[number.clip(max=len(size) - 1)])
    left_out = ~fresh & (around > _STEADY * digit)
    if left_out.any():
        note(
            f"{where}: {int(left_out.sum())} of {len(position)} samples repeat the pose before them to the last digit "
            "while the body moves: they are left out"
        )
    return ~left_out


def _require_times(where: str, time: Array) -> None:
    """Refuse times of samples that are too few, not finite, or do not increase."""
    if len(time) < 2:
        raise InputDataError(f"{where}: {len(time)} samples with a pose.", "at least 2.", "leave this recording out.")
    if not np.isfinite(time).all():
        raise InputDataError(
            f"{where}: {np.count_nonzero(~np.isfinite(time))} times are not finite.",
            "a finite time for each sample.",
            "remove these samples, or take the original.",
        )
    steps = np.diff(time)
    if (bad := np.flatnonzero(steps <= 0)).size:
        k = int(bad[0])
        raise InputDataError(
            f"{where}: time {time[k + 1]:.15g} comes after {time[k]:.15g} ({bad.size} of {len(time)} are so).",
            "times that increase from sample to sample.",
            "remove the samples that are there twice." if (steps >= 0).all() else "sort the samples by time.",
        )


def _require_in_range(where: str, track: Track) -> None:
    """Refuse a track with numbers that are too large, or with times too close to each other."""
    for name, unit, values in (("times", "s", track.time_s), ("positions", "m", track.position_m)):
        if (largest := float(np.abs(values).max())) > LARGEST:
            raise InputDataError(
                f"{where}: {name} up to {largest:.4g} {unit}.",
                f"up to {LARGEST:g} {unit}.",
                "check the unit and the samples, and leave out wrong ones.",
            )
    if (shortest := float(np.diff(track.time_s).min())) < SHORTEST_STEP_S:
        raise InputDataError(
            f"{where}: two times are {shortest:.2g} s apart.",
            f"{SHORTEST_STEP_S:g} s or more.",
            "check the unit of the times, and remove repeated samples.",
        )


SI = Units()
"""Metres and seconds, unless that cannot be."""


def track_files(source: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return the file, or the files with one of the suffixes in a folder, sorted by name.

    Raises:
        InputDataError: If there is none.
    """
    allowed = f"a {' or '.join(suffixes)} file, or a folder of them."
    if not os.path.lexists(source):
        raise InputDataError(f"{source}: no such file or directory.", allowed, "check the path.")
    if not source.is_dir():
        return [require_regular_file(source)]
    files = [require_regular_file(path) for path in entries_of(source) if path.suffix.lower() in suffixes]
    if not files:
        raise InputDataError(f"{source}: no {' or '.join(suffixes)} files.", allowed, "check the path and the format.")
    return files


def read_text(path: Path) -> str:
    """Return the text of a file in UTF-8, with or without a byte order mark.

    Raises:
        InputDataError: If it cannot be read, or is no such text.
    """
    return read_text_file(path, "utf-8-sig")


def require_name(name: str, where: str) -> str:
    """Return a name that becomes that of a body or of a file of the capture.

    Args:
        name: The name.
        where: Where it stands, for the message.

    Raises:
        InputDataError: If it is not legal in a manifest.
    """
    try:
        return TypeAdapter(Name).validate_python(name)
    except ValidationError:
        raise InputDataError(
            f"{where}: {shown(name)} is no name.",
            "letters, digits, '_', '.' and '-', beginning with a letter or digit.",
            "change the name there.",
        ) from None


def from_zero(tracks: Mapping[str, Track]) -> dict[str, Track]:
    """Return the tracks with the earliest time of all of them as time zero: clocks often count from 1970."""
    first = min(float(track.time_s[0]) for track in tracks.values())
    return {body: replace(track, time_s=track.time_s - first) for body, track in tracks.items()}


def episode_names(stems: Sequence[str]) -> list[str]:
    """Return legal, distinct names of episodes for names of files."""
    names: dict[str, None] = {}
    repeated: dict[str, int] = {}
    for stem in stems:
        name = re.sub(r"[^A-Za-z0-9_.-]+", "-", stem).strip("-.")[:_LONGEST_NAME] or "episode"
        count = repeated.get(name, 1)
        while (chosen := name if count == 1 else f"{name}-{count}") in names:
            count += 1
        names[chosen], repeated[name] = None, count
    return list(names)


def write_tracks(
    directory: Path,
    out: Path | str,
    stems: Sequence[str],
    tracks: Iterable[dict[str, Track]],
    up: Literal["z", "y"],
    splits: tuple[int | None, int | None, int],
) -> ImportResult:
    """Write custom tracks as a capture, each an episode that begins at zero, with splits that are drawn.

    Args:
        directory: To write into.
        out: What the directory will be called.
        stems: What the episodes are called where they come from.
        tracks: By body, of each episode.
        up: Which axis points up.
        splits: Episodes to fit on, to test on, and the seed of the permutation: see `drawn_splits`.
    """
    recordings = [
        Recording(name=name, tracks=from_zero(own)) for name, own in zip(episode_names(stems), tracks, strict=True)
    ]
    bodies = dict.fromkeys(name for recording in recordings for name in recording.tracks)
    drawn = drawn_splits(recordings, *splits)
    return write_recordings(directory, out, upright(up), (Body(name=name) for name in bodies), recordings, drawn)


def drawn_splits(
    recordings: Sequence[Recording], n_train: int | None, n_test: int | None, seed: int
) -> dict[str, tuple[str, ...]]:
    """Return the splits: each group permuted by the seed, then groups in turn; the first are "train", the next "test".

    Args:
        recordings: The episodes.
        n_train: Number of training episodes; None: 60 % of those that are not asked for as tests.
        n_test: Number of test episodes; None: all others.
        seed: Of `numpy.random.default_rng`.

    Raises:
        InputDataError: If there are fewer episodes.
    """
    order = _in_turn(recordings, seed)
    n_train, n_test = _sizes(len(order), n_train, n_test)
    splits = {"train": tuple(order[:n_train]), "test": tuple(order[n_train : n_train + n_test])}
    return {name: episodes for name, episodes in splits.items() if episodes}


def _in_turn(recordings: Sequence[Recording], seed: int) -> list[str]:
    """Return the names of the episodes, each group permuted by the seed, one of each group in turn."""
    rng = np.random.default_rng(seed)
    groups: dict[str | None, list[str]] = {}
    for recording in recordings:
        groups.setdefault(recording.group, []).append(recording.name)
    shuffled = [[names[k] for k in rng.permutation(len(names))] for names in groups.values()]
    longest = max(map(len, shuffled))
    return [names[k] for k in range(longest) for names in shuffled if k < len(names)]


def _sizes(episodes: int, n_train: int | None, n_test: int | None) -> tuple[int, int]:
    """Return how many episodes are to train and to test on; without an answer, a share and all others."""
    if n_train is None:
        n_train = episodes - n_test if n_test is not None else math.ceil(_TRAIN_SHARE * episodes)
    n_test = episodes - n_train if n_test is None else n_test
    if n_train < 1 or n_test < 0 or n_train + n_test > episodes:
        raise InputDataError(
            f"{max(n_train, 0)} training and {max(n_test, 0)} test episodes of {episodes} recordings.",
            f"at least 1 to train on, and no more than {episodes} together.",
            "change --train or --test, or leave them out.",
        )
    return n_train, n_test


def write_recordings(
    directory: Path,
    out: Path | str,
    world: World,
    bodies: Iterable[Body],
    recordings: Sequence[Recording],
    splits: dict[str, tuple[str, ...]],
    articulations: Iterable[Articulation] = (),
) -> ImportResult:
    """Write the manifest and the tracks into an empty directory that becomes `out`."""
    manifest = CaptureManifest(
        format="cgwm-capture/1",
        world=world,
        bodies=tuple(bodies),
        articulations=tuple(articulations),
        splits=splits,
        episodes={recording.name: recording.entry for recording in recordings if recording.entry != Episode()},
    )
    write_manifest(directory / "capture.toml", manifest)
    (directory / "tracks").mkdir()
    for recording in progress(recordings, "recordings", unit="recording"):
        (directory / "tracks" / f"{recording.name}.csv").write_text(tracks_csv(recording.tracks), encoding="utf-8")
    return ImportResult(
        capture=str(out),
        episodes=len(recordings),
        samples=sum(len(track) for recording in recordings for track in recording.tracks.values()),
        splits={name: len(episodes) for name, episodes in splits.items()},
        warnings=gap_warnings(recordings),
    )


def _hardly_seconds(where: str, step: float) -> InputDataError:
    """Return the error of times without a unit that grow by so much from sample to sample."""
    unit = "ms" if step < 500 else "us" if step < 5e5 else "ns"
    todo = f"add --time-unit {unit} (or, if these are seconds: --time-unit s)."
    if step == 1:
        todo = (
            "numbers of frames: divide them by the frame rate (csv: --frame-rate HZ). Or add --time-unit ms "
            "(if these are seconds: s)."
        )
    found = f"{where}: from sample to sample the time grows by {step:.6g}: hardly seconds."
    return InputDataError(found, "seconds, or another unit that is named.", todo)


def require_only(where: str, kind: str, only: str | None, legal: Iterable[str]) -> None:
    """Refuse a name given with --only that none of the source has.

    Raises:
        InputDataError: If it is not among the legal ones.
    """
    names = list(legal)
    if only is not None and only not in names:
        found, todo = f"{where}: no {kind} '{only}'.", "pass one of these with --only, or leave it out."
        raise InputDataError(found, f"{', '.join(names)}.", todo)


def gap_warnings(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return a warning that names the recordings whose times have gaps, with the samples that are missing in each.

    Samples without a pose leave gaps, and so do frames that a camera dropped.
    """
    found = [gaps for recording in recordings for gaps in _gaps_of(recording)]
    if not found:
        return ()
    worst = [words for _, words in sorted(found, key=lambda one: -one[0])[:_GAPS_NAMED]]
    more = f"; {len(found) - len(worst)} further tracks have gaps, too" if len(found) > len(worst) else ""
    return (f"samples are missing: {'; '.join(worst)}{more}. Gaps are allowed: nothing is filled in.",)


def _gaps_of(recording: Recording) -> Iterator[tuple[int, str]]:
    """Yield what is missing in the tracks of a recording, as `_gaps` returns it."""
    for body, track in recording.tracks.items():
        gaps = _gaps(recording.name if len(recording.tracks) == 1 else f"{recording.name} ({body})", track)
        if gaps is not None:
            yield gaps


def _gaps(name: str, track: Track) -> tuple[int, str] | None:
    """Return how many samples a track lacks, and the words that say so; None without a gap."""
    steps = np.diff(track.time_s)
    usual = float(np.median(steps)) if len(steps) else 0.0
    gaps = np.flatnonzero(steps > _GAP_STEPS * usual)
    if not len(gaps):
        return None
    missing = int(np.rint(steps[gaps] / usual).sum()) - len(gaps)
    k = gaps[np.argmax(steps[gaps])]
    where = f"the longest of {1e3 * steps[k]:.3g} ms at {track.time_s[k]:.3f} s"
    return missing, f"{name} lacks {missing} of {missing + len(track)} samples in {_count(len(gaps))}, {where}"


def _count(gaps: int) -> str:
    return "1 gap" if gaps == 1 else f"{gaps} gaps"


def upright(up: Literal["z", "y"]) -> World:
    """Return a world without a ground whose gravity points against an axis; numbers stay as they are."""
    return World(gravity_m_s2=(0.0, 0.0, -9.81) if up == "z" else (0.0, -9.81, 0.0))


def _require_as_many(where: str, **parts: Array | None) -> None:
    """Refuse parts of a recording, by their name, of different lengths."""
    counts = {name: len(values) for name, values in parts.items() if values is not None}
    if len(set(counts.values())) > 1:
        raise InputDataError(
            f"{where}: {', '.join(f'{count} {name}' for name, count in counts.items())}.",
            "as many of each.",
            "take the original, or fill in nan where nothing was measured.",
        )


def _spin(where: str, omega_rad_s: Array) -> Array:
    """Return measured spins (T, 3), which are known for every sample."""
    lacking = int(np.count_nonzero(~np.isfinite(omega_rad_s).all(1)))
    if lacking:
        raise InputDataError(
            f"{where}: {lacking} of {len(omega_rad_s)} samples have no finite angular velocity.",
            "three finite numbers for every sample with a pose, or no such columns.",
            "fill them in, or remove the columns.",
        )
    if (largest := float(np.abs(omega_rad_s).max())) > FASTEST_RAD_S:
        raise InputDataError(
            f"{where}: angular velocities up to {largest:.4g} rad/s.",
            f"up to {FASTEST_RAD_S:g} rad/s.",
            "convert them to rad/s.",
        )
    return omega_rad_s


def _force(where: str, force_n: Array) -> Array | None:
    """Return measured forces (T, 3), which are known for every sample; None where they are for none."""
    known = np.isfinite(force_n).all(1)
    if not known.any():
        return None
    if not known.all():
        raise InputDataError(
            f"{where}: {np.count_nonzero(~known)} of {len(force_n)} samples have no finite force.",
            "three finite numbers for every sample with a pose of a driven body, none for others.",
            "fill them in, or leave out the lines.",
        )
    if (largest := float(np.abs(force_n).max())) > LARGEST:
        raise InputDataError(f"{where}: forces up to {largest:.4g} N.", f"up to {LARGEST:g} N.", "check their unit.")
    return force_n


def _unit(where: str, quat_wxyz: Array) -> Array:
    norm = np.linalg.norm(quat_wxyz, axis=1)
    off = np.abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE
    if off.any():
        raise InputDataError(
            f"{where}: {np.count_nonzero(off)} of {len(norm)} quaternions have another norm than 1, "
            f"the first {norm[off][0]:.4f}.",
            f"norm 1 within {QUATERNION_NORM_TOLERANCE:g}.",
            "normalise the quaternions where they are made.",
        )
    return quat_wxyz / norm[:, None]
