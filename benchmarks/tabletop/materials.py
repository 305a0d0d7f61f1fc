"""The grounds: three materials that differ clearly in friction and in how high an object bounces."""

from __future__ import annotations

from cgwm.datasets.synthetic.dynamics import ContactTruth

MATERIALS: dict[str, ContactTruth] = {
    "acrylic": ContactTruth(
        friction=0.2, friction_fingertip=0.3, natural_time=0.0028, damping_ratio=0.25, impedance=0.97
    ),
    "wood": ContactTruth(friction=0.35, friction_fingertip=0.3, natural_time=0.0032, damping_ratio=0.4, impedance=0.97),
    "rubber": ContactTruth(
        friction=0.5, friction_fingertip=0.3, natural_time=0.0038, damping_ratio=0.6, impedance=0.97
    ),
}
"""True contacts by ground; a ball dropped on them rebounds with about 0.51, 0.36 and 0.25 of its speed."""
