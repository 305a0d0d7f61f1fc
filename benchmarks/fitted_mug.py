"""A model of the mug of `control.py` from photos and one video: what its `--fits` takes for `mug`.

python benchmarks/fitted_mug.py OUT [--seed 0]

The scanned mug of the benchmark of Fall, Push and Tip, whose cache it needs (`python -m tabletop.prepare`), is pushed
once by a finger: 32 photos, one video of 15 frames from two cameras. Cameras are calibrated, shape, poses and numbers
fitted from the images alone; the mass is told. OUT/capture, OUT/model, OUT/push.toml and, for MuJoCo alone, the true
convex parts in OUT/true_parts are written, as by `cgwm demo --scene control`.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from cgwm.datasets.synthetic import read_truth
from cgwm.datasets.synthetic.dynamics import FINGERTIP, FINGERTIP_RADIUS
from cgwm.datasets.synthetic.objects import write_parts
from cgwm.schemas import ControlTask, task_toml
from fitted_images import fitted_images
from tabletop.capture import make_capture
from tabletop.objects import load_item

MATERIAL = "wood"


def main() -> None:
    """Make the capture, fit it and write the task."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    capture, solid = given.out / "capture", load_item("mug").solid
    make_capture(capture, "mug", MATERIAL, "push", given.seed, 1, (480, 360), (640, 480), 32, tests_every=10)
    (given.out / "true_parts").mkdir(parents=True)
    contact = read_truth(capture).contact
    task = ControlTask.model_validate(
        {
            "robot": {"name": FINGERTIP, "radius_m": FINGERTIP_RADIUS},
            "plant": {
                "kind": "mujoco",
                "meshes": [f"true_parts/{name}" for name in write_parts(given.out / "true_parts", solid)],
                "friction": contact.friction,
                "finger_friction": contact.friction_fingertip,
                "mass_kg": solid.mass,
            },
        }
    )
    (given.out / "push.toml").write_text(task_toml(task), encoding="utf-8")
    (capture / "cameras.json").unlink()  # the true ones
    numbers = fitted_images(capture, given.out / "model", given.seed)
    print(json.dumps({"found": numbers, "friction": contact.friction, "of the finger": contact.friction_fingertip}))


if __name__ == "__main__":
    main()
