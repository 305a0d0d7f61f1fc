"""Synthetic scenes, simulated with MuJoCo and rendered without OpenGL, as captures on disk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ...schemas import UsageError, did_you_mean
from ...schemas.quantities import MOST_SEED
from ..io.atomic import new_directory
from .truth import TRUTH_FILE, TRUTH_MESH, TruthFile, read_truth

if TYPE_CHECKING:
    from .plan import ScenePlan

__all__ = [
    "RENDERERS",
    "SCENES",
    "TRUTH_FILE",
    "TRUTH_MESH",
    "TruthFile",
    "make_scene",
    "plan_scene",
    "read_truth",
]

SCENES = ("fall", "push")
"""Names of the scenes."""
RENDERERS = ("raycast",)
"""Names of the renderers."""


def make_scene(
    name: str,
    out: Path | str,
    seed: int = 0,
    renderer: str = "raycast",
    overwrite: bool = False,
    *,
    photo_size: tuple[int, int] = (640, 480),
    video_size: tuple[int, int] = (480, 360),
    photos: int = 48,
    splits: tuple[str, ...] = ("train", "test"),
) -> Path:
    """Write the capture of a synthetic scene; the same arguments give the same bytes.

    Object, parameters and motion depend on the scene and the seed alone, not on sizes and counts.

    Args:
        name: One of `SCENES`.
        out: Directory of the capture.
        seed: Seed of the object, its parameters, the motion, the cameras and the noise.
        renderer: One of `RENDERERS`.
        overwrite: Replace what is at `out`.
        photo_size: Width and height of the photos [px].
        video_size: Width and height of the video frames [px].
        photos: Number of photos.
        splits: Splits whose episodes are filmed.

    Returns:
        `out` as a path.

    Raises:
        UsageError: If a name or a number is not allowed, or `out` exists.
        NotConvergedError: If no motion could be drawn that stays in view.
    """
    from .record import build_set, record

    if renderer not in RENDERERS:
        near = did_you_mean(renderer, RENDERERS)
        raise UsageError(f"unknown renderer '{renderer}'.", ", ".join(RENDERERS) + "." + near, "name one of these.")
    if photos < 3 or min(*photo_size, *video_size) < 16:
        raise UsageError(
            f"{photos} photos of {photo_size[0]}x{photo_size[1]} px, videos of {video_size[0]}x{video_size[1]} px.",
            "at least 3 photos, and sides of at least 16 px.",
            todo="ask for more photos, or for larger ones.",
        )
    with new_directory(Path(out), "capture", overwrite) as directory:
        plan = plan_scene(name, seed)
        plan = replace(plan, episodes=tuple(one for one in plan.episodes if one.split in splits))
        record(build_set(plan, photo_size, video_size, photos), directory)
    return Path(out)


def plan_scene(name: str, seed: int = 0) -> ScenePlan:
    """Draw the object, the true physics and the true motion of every episode of a scene, without rendering.

    Args:
        name: One of `SCENES`.
        seed: Any integer from 0 to `MOST_SEED`.

    Raises:
        UsageError: If the name or the seed is not allowed.
        NotConvergedError: If no motion could be drawn that stays in view.
    """
    from .fall import plan_fall
    from .push import plan_push

    planners: dict[str, Callable[[int], ScenePlan]] = {"fall": plan_fall, "push": plan_push}
    if name not in planners:
        raise UsageError(
            f"unknown scene '{name}'.", ", ".join(SCENES) + "." + did_you_mean(name, SCENES), "name one of these."
        )
    if not 0 <= seed <= MOST_SEED:
        raise UsageError(f"the seed is {seed}.", f"integers from 0 to {MOST_SEED}.", "pass another --seed.")
    return planners[name](seed)
