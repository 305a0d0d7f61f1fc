"""cgwm with one thing taken from the truth before its fit: what that thing costs.

Shape: the collision spheres are those of the true mesh, as `cgwm fit` makes them of a mesh, and stay as they are. Mass:
centre of mass and inertia (the capture gives the mass). Poses: those of the training episode are given at the frames'
times, true to 0.1 mm and 1 mrad, and the fit is to tracks. Looks stay as learned.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.manifest import write_manifest
from cgwm.datasets.capture.tracks import Track, write_tracks
from cgwm.datasets.models.model import Model, read_model, write_model
from cgwm.datasets.shapes.ply import Splats
from cgwm.datasets.synthetic import read_truth
from cgwm.pipeline.demo.truth_tables import OBJECT
from cgwm.pipeline.fit import fit
from cgwm.schemas import PhysConfig
from tabletop.true_world import spheres_in

from .base import TRAIN_EPISODE, Cell
from .cgwm_default import FittedCgwm

Part = Literal["shape", "mass", "poses"]
NOISE = (1e-4, 1e-3)
"""Stated noise of the true poses [m, rad]."""


@dataclass(frozen=True)
class TruePart:
    """The default fit, with one part from the truth."""

    name: str
    part: Part

    def fit(self, cell: Cell, budget_s: float | None) -> FittedCgwm:
        """Fit the training episode; it takes the time that it takes.

        Raises:
            CgwmError: As `cgwm fit` has them.
        """
        supervise = "tracks" if self.part == "poses" else "images"
        config = PhysConfig.model_validate({"supervise": supervise, "seed": cell.seed, "device": cell.device})
        with tempfile.TemporaryDirectory() as folder:
            parent, capture, out = (Path(folder) / name for name in ("parent", "capture", "model"))
            write_model(parent, self._parent(cell))
            if self.part == "poses":
                with_true_poses(cell.capture, capture)
            else:
                capture = cell.capture
            started = time.perf_counter()
            fit(capture, out, stage="phys-geo", parent=parent, phys_config=config)
            return FittedCgwm(read_model(out), time.perf_counter() - started)

    def _parent(self, cell: Cell) -> Model:
        model = read_model(cell.splats)
        if self.part == "shape":
            return with_true_shape(model, cell.capture)
        return with_true_mass(model, cell.capture) if self.part == "mass" else model


def with_true_shape(model: Model, capture: Path) -> Model:
    """Return a model whose object collides as its true mesh."""
    true = spheres_in(capture, read_truth(capture).object.mesh)
    count = len(true.radii)
    spheres = Splats(
        means=np.asarray(true.centers, np.float32),
        scales=np.asarray(true.radii, np.float32),
        colors=np.full((count, 3), 0.5, np.float32),
        opacities=np.ones(count, np.float32),
    )
    changed = tuple(
        body.model_copy(update={"radius_factor": 1.0, "convex": true.convex}) if body.name == OBJECT else body
        for body in model.file.bodies
    )
    file = model.file.model_copy(update={"bodies": changed})
    return replace(model, file=file, collision=model.collision | {OBJECT: spheres})


def with_true_mass(model: Model, capture: Path) -> Model:
    """Return a model whose object has its true centre of mass and inertia."""
    true = read_truth(capture).object
    changed = tuple(
        body.model_copy(update={"com_m": tuple(true.com_m), "inertia_kg_m2": tuple(true.inertia_kg_m2)})
        if body.name == OBJECT
        else body
        for body in model.file.bodies
    )
    kept = tuple(p for p in model.file.parameters if not p.name.startswith(f"{OBJECT}."))
    blocks = tuple(b for b in model.file.correlations if set(b.parameters) <= {p.name for p in kept})
    update = {"bodies": changed, "parameters": kept, "correlations": blocks}
    return replace(model, file=model.file.model_copy(update=update))


def with_true_poses(source: Path, target: Path) -> None:
    """Make a capture of the training episode alone, whose track of the object is true at the times of the frames."""
    capture, truth = Capture.open(source, splits=("train",)), read_truth(source)
    target.mkdir()
    for path in source.iterdir():
        if path.name not in ("tracks", "capture.toml"):
            (target / path.name).symlink_to(path)
    motion = truth.episodes[TRAIN_EPISODE]
    cameras = capture.videos(TRAIN_EPISODE)
    times = np.unique(np.concatenate([capture.frame_times(camera, TRAIN_EPISODE) for camera in cameras]))
    rows = np.abs(np.asarray(motion.time_s)[:, None] - times).argmin(0)
    position, quat = (np.asarray(values, np.float64)[rows] for values in (motion.position_m, motion.quat_wxyz))
    true = {OBJECT: Track(np.asarray(motion.time_s, np.float64)[rows], position, quat)}
    (target / "tracks").mkdir()
    write_tracks(target / "tracks" / f"{TRAIN_EPISODE}.csv", dict(capture.tracks(TRAIN_EPISODE)) | true)
    measured = capture.manifest.measurement.model_copy(
        update={"position_std_m": NOISE[0], "rotation_std_rad": NOISE[1]}
    )
    manifest = capture.manifest.model_copy(update={"measurement": measured, "splits": {"train": (TRAIN_EPISODE,)}})
    write_manifest(target / "capture.toml", manifest)
