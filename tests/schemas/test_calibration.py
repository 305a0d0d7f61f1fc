"""What a calibration report says of its centres."""

from cgwm.schemas.calibration import CalibrationReport, ImageVerdict


def _lines(own: float | None, whole: float | None) -> list[str]:
    images = {"a.jpg": ImageVerdict(registered=True, center_std_percent=own), "b.jpg": ImageVerdict(registered=False)}
    return CalibrationReport.model_construct(images=images, videos={}, center_std_percent=whole)._centers()


def test_the_line_on_optical_centres_needs_the_median_and_a_centre() -> None:
    assert _lines(0.5, None) == [] and _lines(None, 0.2) == []
    assert _lines(0.5, 0.2) == ["optical centres: +- 0.2 % of their extent (median), +- 0.5 % at a.jpg"]
