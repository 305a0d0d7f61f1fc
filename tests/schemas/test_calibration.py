"""What a calibration report says of its centres."""

from typing import Any

import pytest
from cgwm.schemas import KnownCameraDistance, KnownDistance, Marker
from cgwm.schemas.calibration import CalibrationReport, ImageVerdict
from pydantic import BaseModel, ValidationError


def _lines(own: float | None, whole: float | None) -> list[str]:
    images = {"a.jpg": ImageVerdict(registered=True, center_std_percent=own), "b.jpg": ImageVerdict(registered=False)}
    return CalibrationReport.model_construct(images=images, videos={}, center_std_percent=whole)._centers()


def test_the_line_on_optical_centres_needs_the_median_and_a_centre() -> None:
    assert _lines(0.5, None) == [] and _lines(None, 0.2) == []
    assert _lines(0.5, 0.2) == ["optical centres: +- 0.2 % of their extent (median), +- 0.5 % at a.jpg"]


@pytest.mark.parametrize(
    ("kind", "fields", "words"),
    [
        (Marker, {"id": 1, "side_m": 67.0}, "a marker of 67 m; .* 0.067 if these are millimetres"),
        (Marker, {"id": 1, "side_m": 0.000067}, "a marker of 6.7e-05 m; lengths are in metres"),
        (KnownCameraDistance, {"images": ("a.jpg", "b.jpg"), "distance_m": 300.0}, "0.3 if these are millimetres"),
        (KnownDistance, {"distance_m": 300.0, "a_px": {}, "b_px": {}}, "a distance of 300 m"),
    ],
)
def test_a_scale_in_another_unit_is_refused(kind: type[BaseModel], fields: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        kind.model_validate(fields)


def test_the_sides_of_real_markers_are_taken() -> None:
    assert [Marker(id=1, side_m=side).side_m for side in (0.002, 0.067, 1.5)] == [0.002, 0.067, 1.5]
