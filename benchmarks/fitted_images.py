"""A model from photos and one video, as the benchmarks of control fit it: cameras, shape, poses and numbers."""

from __future__ import annotations

from pathlib import Path

from cgwm.pipeline.calibrate.stage import calibrate
from cgwm.pipeline.fit import fit
from cgwm.schemas import CalibrateConfig, PhysConfig, SplatConfig


def fitted_images(capture: Path, model: Path, seed: int) -> dict[str, tuple[float, float | None]]:
    """Calibrate the cameras of a capture and fit it from its images alone.

    Args:
        capture: The capture, without cameras.
        model: Where to write the model.
        seed: Seed of all stages.

    Returns:
        Estimate and standard error of each parameter, by name.
    """
    calibrate(capture, CalibrateConfig(max_features=2048, seed=seed))
    found = fit(
        capture,
        model,
        splat_config=SplatConfig(seed=seed),
        phys_config=PhysConfig(supervise="images", population=48, generations=5, iterations=6, seed=seed),
    )
    return {one.name: (one.estimate, one.std_error) for one in found.parameters}
