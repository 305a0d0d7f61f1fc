"""Contact laws by pair of materials at the start of a fit, and what is known about them before.

A pair has the numbers that [[pairs]] of the capture gives; its friction, where it is not given, the geometric mean of
those of its two materials. What is left open starts at the medians of the priors. Given numbers are medians of priors
as well: the fit estimates every pair that its episodes show.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from ...datasets.capture.capture import Capture
from ...schemas import CaptureManifest, ContactParameters, InputDataError, ModelFile, PairContact
from ...schemas.materials import of_pair, pair_of
from ..physics.parameters import CONTACT_PARAMETERS

Pair = tuple[str, str]


MOVED = ("free", "link")
"""Motions of bodies that physics moves."""


@dataclass(frozen=True)
class TouchingBodies:
    """Two bodies that can touch, or one and what does not move."""

    bodies: tuple[str, ...]
    """Their names; one for a body and the ground, or a surface."""
    pair: Pair | None
    """Their materials; None where one of them has none."""
    surface: str | None = None
    """Name of the surface that the body can touch; None for the ground or another body."""

    def __str__(self) -> str:
        other = "the ground" if self.surface is None else f"surface '{self.surface}'"
        return " and ".join([f"'{name}'" for name in self.bodies] + [other] * (len(self.bodies) == 1))


def touching_bodies(manifest: CaptureManifest) -> Iterator[TouchingBodies]:
    """Yield the bodies that can touch: each free one and link with the ground, every surface, and every other body."""
    bodies, ground = manifest.bodies, manifest.world.ground
    for index, body in enumerate(bodies):
        if body.motion in MOVED and ground is not None:
            yield TouchingBodies((body.name,), _pair(body.material, ground.material))
        for surface in manifest.surfaces if body.motion in MOVED else ():
            yield TouchingBodies((body.name,), _pair(body.material, surface.material), surface.name)
        for other in bodies[index + 1 :]:
            if body.motion in MOVED or other.motion in MOVED:
                yield TouchingBodies((body.name, other.name), _pair(body.material, other.material))


def _pair(first: str | None, second: str | None) -> Pair | None:
    return None if first is None or second is None else pair_of(first, second)


def with_pusher_law(manifest: CaptureManifest) -> CaptureManifest:
    """Return a manifest of one moved body in which contact with a driven body without material is a pair of its own.

    Both get their name as material, as far as they have none; the ground stays as it is, so that the moved body and it
    keep the contact of all other pairs. Manifests of several moved bodies, or of links, are returned as they are.
    """
    moved = [body for body in manifest.bodies if body.motion in MOVED]
    unnamed = {body.name for body in manifest.bodies if body.motion == "driven" and body.material is None}
    taken = {material.name for material in manifest.materials}
    if len(moved) != 1 or manifest.articulations or not unnamed or (unnamed | {moved[0].name}) & taken:
        return manifest
    named = unnamed | ({moved[0].name} if moved[0].material is None else set())
    bodies = tuple(
        body.model_copy(update={"material": body.name}) if body.name in named else body for body in manifest.bodies
    )
    return manifest.model_copy(update={"bodies": bodies})


def given_numbers(manifest: CaptureManifest) -> dict[Pair, dict[str, float]]:
    """Return the contact parameters of pairs of materials that a capture knows, by pair and name."""
    single = {material.name: material.friction for material in manifest.materials}
    pairs = {pair_of(first, second) for first in single for second in single}
    found: dict[Pair, dict[str, float]] = {}
    for first, second in sorted(pairs):
        one, other = single[first], single[second]
        if one is not None and other is not None:
            found[first, second] = {"friction": math.sqrt(one * other)}
    for entry in manifest.pairs:
        numbers = {p.name: getattr(entry, p.name) for p in CONTACT_PARAMETERS}
        known = {name: value for name, value in numbers.items() if value is not None}
        pair = pair_of(*entry.materials)
        found[pair] = found.get(pair, {}) | known
    return found


def require_known_pairs(capture: Capture, split: str) -> None:
    """Refuse pairs of materials whose friction nobody gave, and which no episode can show.

    Raises:
        InputDataError: With the materials and the bodies of the first such pair.
    """
    known = {pair for pair, numbers in given_numbers(capture.manifest).items() if "friction" in numbers}
    asked = [one for one in touching_bodies(capture.manifest) if one.pair is not None and one.pair not in known]
    shown = _shown(capture, split, asked) if asked else set()
    for one in asked:
        if one.pair is not None and one.pair not in shown:
            first, second = one.pair
            raise InputDataError(
                f"{capture.root / 'capture.toml'}: nothing gives the friction of '{first}' and '{second}' (of {one}), "
                f"and no episode of split '{split}' shows them together.",
                f'[[pairs]] with materials = ["{first}", "{second}"] and friction, or friction of both materials.',
                "give it, or leave out the material of one of the two, which then has the contact of all other pairs.",
            )


def _shown(capture: Capture, split: str, asked: Sequence[TouchingBodies]) -> set[Pair | None]:
    """Return the pairs of materials whose moving bodies are tracked together in an episode."""
    moving = {body.name for body in capture.manifest.bodies if body.motion != "fixed"}
    tracked = [set(capture.tracks(name)) for name in capture.episodes(split)]
    return {one.pair for one in asked if any(set(one.bodies) & moving <= names for names in tracked)}


@dataclass(frozen=True, kw_only=True)
class StartLaws:
    """Contact laws at the start of a fit."""

    contact: ContactParameters
    """The law of all pairs that have none of their own; of the only pair in use where there is one."""
    pairs: tuple[PairContact, ...]
    """The laws of pairs of materials."""
    medians: Mapping[str, float]
    """Medians of the priors of contact parameters that the capture gives, by name."""


def start_laws(file: ModelFile, manifest: CaptureManifest) -> StartLaws:
    """Return the laws of all pairs of materials of a model, from an earlier fit or from what the capture gives.

    Where all contacts are of one pair, its law is `contact`: the names of its parameters are plain ones.
    """
    given = given_numbers(manifest)
    used = dict.fromkeys(one.pair for one in touching_bodies(manifest))
    earlier = {pair_of(*entry.materials): entry for entry in file.pairs}
    contact = file.contact or ContactParameters()
    only = next(iter(used)) if len(used) == 1 else None
    if only is not None:
        contact = earlier.get(only, _law(contact, given.get(only, {}), file.contact is not None))
    laws = {
        pair: earlier.get(pair, PairContact(materials=pair, **_law(contact, given.get(pair, {}), False).model_dump()))
        for pair in sorted({*given, *(pair for pair in used if pair is not None)})
        if pair != only
    }
    medians = {of_pair(name, pair): value for pair, numbers in given.items() if pair in used and pair != only
               for name, value in numbers.items()}  # fmt: skip
    return StartLaws(
        contact=ContactParameters(**contact.model_dump(include=set(ContactParameters.model_fields))),
        pairs=tuple(laws.values()),
        medians=medians | (given.get(only, {}) if only is not None else {}),
    )


def _law(contact: ContactParameters, given: Mapping[str, float], fitted: bool) -> ContactParameters:
    """Return a law with given numbers, which those of an earlier fit precede."""
    return contact if fitted else contact.model_copy(update=dict(given))
