"""A mystery: a case whose effect is drawn from a seed, with the truth in an encoded file."""

from __future__ import annotations

import base64
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from ....schemas import HiddenEffect, InputDataError, SealedFile, UsageError, read_json
from ....schemas.documents import parse_json
from ....schemas.quantities import MOST_SEED
from .case import Case
from .record import make_capture
from .things import Kind

CHOICES: tuple[tuple[Kind, str], ...] = (
    ("ball", "magnus_lift"),
    ("cube", "linear_drag"),
    ("ball", "quadratic_drag"),
    ("ball", "spin_damping"),
    ("cube", "com_offset"),
    ("ball", "gravity_tilt"),
    ("ball", "rolling_resistance"),
    ("cube", "anisotropic_friction"),
    ("cube", "torsional_friction"),
    ("cube", "clock_scale"),
    ("ball", "length_scale"),
    ("ball", "marker_offset"),
)
"""Pairs of body and effect: six effects in flight, three in contact, three of the measurement."""
NOTHING = 0.15
"""Probability that nothing is hidden, so that `none_missing` is the correct verdict."""
HOW_TO_OPEN = "The report tells it at its end. Otherwise: decode zlib_base64 by base64, then decompress it by zlib."


def draw_mystery(seed: int) -> Case:
    """Return the case of a seed: a body with one effect or none; six episodes for training, four for testing.

    Raises:
        UsageError: If the seed is negative or larger than `MOST_SEED`.
    """
    if not 0 <= seed <= MOST_SEED:
        raise UsageError(f"the seed is {seed}.", f"integers from 0 to {MOST_SEED}.", "pass another --seed.")
    rng = np.random.default_rng([seed, *b"mystery"])
    nothing = rng.random() < NOTHING
    thing, effect = CHOICES[int(rng.integers(len(CHOICES)))]
    return Case(
        name="mystery",
        thing=thing,
        effects=() if nothing else (effect,),
        magnitude="large",
        seed=seed,
        noise_given=True,
    )


def make_mystery(capture: Path, sealed: Path, case: Case) -> None:
    """Write the capture of a case, and its truth into an encoded file; nothing in the capture reveals it."""
    truth = make_capture(capture, case, sealed.with_name(f".{sealed.name}.open"))
    content = truth.read_bytes()
    truth.unlink()
    packed = base64.b64encode(zlib.compress(content, 9)).decode("ascii")
    file = SealedFile(how_to_open=HOW_TO_OPEN, zlib_base64=packed)
    sealed.write_text(file.model_dump_json(indent=1) + "\n", encoding="utf-8")


def open_sealed(path: Path) -> tuple[HiddenEffect, ...]:
    """Read the truth from an encoded file.

    Raises:
        InputDataError: If the file is not such a file.
    """
    try:
        packed = base64.b64decode(read_json(path, SealedFile).zlib_base64)
        content: dict[str, Any] = parse_json(zlib.decompress(packed).decode(), path)
        found = content["effects"]
        return tuple(HiddenEffect(name=e["name"], values=e["values"], form=e["form"]) for e in found)
    except (ValueError, zlib.error, KeyError, TypeError) as error:
        raise InputDataError(f"{path}: its content cannot be opened ({error}).", todo="make it again.") from None
