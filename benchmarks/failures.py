"""Where a fitted model fails: the test episode with the largest error, as it was filmed and as it is predicted.

python benchmarks/failures.py MODEL CAPTURE PICTURE.png

Above the frames of one camera, below what the model renders; the yellow outline is where the object really was. The
start is estimated from the first 0.1 s, as `cgwm eval` does it. docs/results-fits.md links two
of these pictures, from Fall and Push on wood: the mug (episode 010) and the box (episode 006).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.evaluate.evaluation import EpisodeEvaluation
from cgwm.pipeline.evaluate.frame_strips import strips_of
from cgwm.pipeline.evaluate.stage import evaluate_model
from cgwm.pipeline.rendering.contact_sheets import contact_sheet, small_png, telling, tiles

MOMENTS = 7
TILE_PX = 200


def error_m(one: EpisodeEvaluation) -> float:
    """Return the translation error of an episode [m]."""
    return one.errors.translation_error_m or 0.0


def main() -> int:
    """Write the picture, and print what it shows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("picture", type=Path)
    given = parser.parse_args()
    capture = Capture.open(given.capture, splits=("test",))
    found = evaluate_model(read_model(given.model), capture, keep_frames=True)
    worst = max(found.episodes, key=error_m)
    strip = strips_of([worst], capture)[0]
    chosen = telling(strip, MOMENTS)
    real, predicted = tiles(strip, TILE_PX)
    given.picture.write_bytes(small_png(contact_sheet([real[chosen], predicted[chosen]])))
    times = ", ".join(f"{strip.times_s[k]:.2f}" for k in chosen)
    turned = worst.errors.rotation_error_deg or 0.0
    print(
        f"{capture.root.name}, episode {strip.episode}: {1e3 * error_m(worst):.1f} mm, {turned:.1f} deg; at {times} s"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
