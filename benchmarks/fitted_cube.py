"""A model of the cube of `hand.py` from photos and one video: what its `--model` takes.

python benchmarks/fitted_cube.py OUT [--seed 0]

A cube of 6 cm and 0.108 kg with the friction of the scene is tossed on a plane, as in `cgwm demo`: 32 photos, one video
of 15 frames from two cameras. Cameras are calibrated, shape, poses and numbers fitted from the images alone; the mass
is told. OUT/capture, OUT/model and OUT/truth.json are written.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from cgwm.datasets.synthetic import fall, make_scene
from cgwm.datasets.synthetic.dynamics import ContactTruth, draw_contact
from cgwm.datasets.synthetic.objects import SolidObject, extrude
from fitted_images import fitted_images
from hand import FRICTION, HALF_M, MASS_KG


def cube(_: int) -> SolidObject:
    """Return the cube, in the place of the object of a seed."""
    corners = HALF_M * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    vertices, faces = extrude(corners, 2 * HALF_M)
    inertia = MASS_KG * 2 / 3 * HALF_M**2 * np.eye(3)
    return SolidObject(
        family="box", vertices=vertices, faces=faces, parts=(vertices,), mass=MASS_KG, com=np.zeros(3), inertia=inertia
    )


def contact(rng: np.random.Generator) -> ContactTruth:
    """Return the contact of a seed with the friction of the scene."""
    return replace(draw_contact(rng), friction=FRICTION)


def main() -> None:
    """Make the capture and fit it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    fall.make_object, fall.draw_contact = cube, contact
    capture = given.out / "capture"
    make_scene("fall", capture, given.seed, splits=("train",), photo_size=(640, 480), video_size=(480, 360), photos=32)
    numbers = fitted_images(capture, given.out / "model", given.seed)
    truth = {"mass_kg": MASS_KG, "side_m": 2 * HALF_M, **asdict(contact(np.random.default_rng([given.seed, 2])))}
    (given.out / "truth.json").write_text(json.dumps({"truth": truth, "found": numbers}, indent=1) + "\n")
    print(json.dumps(numbers))


if __name__ == "__main__":
    main()
