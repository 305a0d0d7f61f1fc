"""Rollouts of worlds with fixed surfaces: where bodies begin, what is labelled, and what `validate` finds."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.models.model import write_model
from cgwm.datasets.rollouts.dataset import shard_name
from cgwm.pipeline.geometry.viewpoint import rotation_matrix
from cgwm.pipeline.synthesize import synthesize
from cgwm.pipeline.synthesize.plan import resolve_plan
from cgwm.pipeline.synthesize.start_states import draw_start
from cgwm.pipeline.synthesize.supports import Supports
from cgwm.pipeline.validate import validate
from cgwm.schemas import SamplingPlan, Surface, SynthesizeConfig
from helpers.small_model import HALF
from helpers.tray import FLOOR_M, HIGH, bowl, in_tray, tray

UPRIGHT = (np.zeros((1, 3)), np.array([0.02]))
RADIUS = 0.005
"""Radius of the cubes' collision spheres [m]."""


def test_rest_heights_on_floors_walls_slopes_and_shelves() -> None:
    supports = Supports.of(in_tray())

    def rest(x: float, z: float, found: Supports = supports) -> float | None:
        height = found.rest_height(np.array([x, 0.0, z]), *UPRIGHT)
        return height if height is None else height - FLOOR_M

    assert rest(0, FLOOR_M + 0.3) == pytest.approx(0.02, abs=1e-8)
    assert rest(0, FLOOR_M + 0.01) == pytest.approx(0.02, abs=1e-8)  # begins inside the floor
    assert rest(0.26, FLOOR_M + 0.05) == pytest.approx(HIGH + 0.02, abs=1e-8)  # inside a wall
    assert rest(2.0, FLOOR_M + 0.05) is None
    shelf = Surface.model_validate(
        {"name": "shelf", "rectangle": {"half_extents_m": (1, 1)}, "pose": {"position_m": (0, 0, 0.5)}}
    )
    covered = Supports.of(in_tray((*tray(), shelf)))
    assert rest(0, 0.47, covered) == pytest.approx(0.02, abs=1e-8)
    assert rest(0, 0.51, covered) == pytest.approx(0.22, abs=1e-8)
    turned = (0.9659258262890683, 0.0, 0.25881904510252074, 0.0)  # 30 degrees about y
    slope = Surface.model_validate({"name": "slope", "half_space": {}, "pose": {"quat_wxyz": turned}})
    height = Supports.of(in_tray((slope,))).rest_height(np.array([0.1, 0.0, 0.4]), *UPRIGHT)
    assert height == pytest.approx(0.02 / np.cos(np.pi / 6) - 0.1 * np.tan(np.pi / 6), abs=1e-7)
    mesh = Supports.of(in_tray((bowl()[0],), bowl()[1]))
    assert rest(0, FLOOR_M + 0.3, mesh) == pytest.approx(0.02, abs=1e-8)


@pytest.mark.parametrize("start", ["throw", "rest", "slide"])
def test_bodies_begin_in_the_tray_without_overlap(start: str) -> None:
    model = in_tray()
    given = {"start": start} if start == "throw" else {"start": start, "offset_m": 0.04}
    plan = resolve_plan(model, SamplingPlan.model_validate(given)) if start != "slide" else None
    if plan is None:  # slides need a ground, which lies below the tray
        ground = {"ground": {"normal": (0, 0, 1), "offset_m": 0.0}}
        model = type(model)(**vars(model) | {"file": type(model.file).model_validate(model.file.model_dump() | ground)})
        plan = resolve_plan(model, SamplingPlan.model_validate(given))
    supports = Supports.of(model)
    for seed in range(5):
        began = draw_start(model, plan, 1.0, np.random.default_rng(seed))
        for index, body in enumerate(model.file.bodies):
            arms = np.asarray(model.collision[body.name].means) @ rotation_matrix(began.quat_wxyz[index]).T
            radii = np.full(len(arms), RADIUS)
            place = began.position_m[index]
            assert not supports.overlaps(place[None], arms, radii).any()
            lowest = (arms[:, 2] + place[2]).min() - RADIUS - FLOOR_M
            assert lowest > 0.01 if start == "throw" else lowest == pytest.approx(0, abs=1e-7)
            assert np.abs(place[:2]).max() < 0.3


def test_a_dataset_of_bodies_in_a_tray_is_sound(tmp_path: Path) -> None:
    write_model(tmp_path / "model", in_tray())
    config = SynthesizeConfig(rollouts=2, duration_s=0.5, device="cpu", seed=1)
    synthesize(tmp_path / "model", tmp_path / "dataset", config)
    report = validate(tmp_path / "dataset")
    assert report.passed and report.faults == (), report.faults
    assert report.facts["impulse_excess_n_s"] < 1e-12
    shard = tmp_path / "dataset" / shard_name(0, 1)
    with h5py.File(shard) as file:
        contacts = file["data/demo_0/contacts"]
        partners, gaps, normals = (contacts[name][:] for name in ("body_b", "distance", "normal_world"))
        assert set(partners[partners < 0]) >= {-2} and -1 not in partners and partners.min() >= -6
        floor = partners == -2
        assert gaps[floor].min() > -0.01 and np.allclose(normals[floor], (0, 0, 1))
        assert file["data/demo_0/bodies/pos"][:][..., 2].min() > FLOOR_M + 0.5 * HALF
    with h5py.File(shard, "r+") as file:
        distance = file["data/demo_0/contacts/distance"]
        row = int(np.flatnonzero(partners == -2)[0])
        distance[row] = 0.5
    manifest = json.loads((tmp_path / "dataset/dataset.json").read_text())
    manifest["shards"][0]["sha256"] = sha256(shard)
    (tmp_path / "dataset/dataset.json").write_text(json.dumps(manifest))
    (fault,) = (f for f in validate(tmp_path / "dataset").faults if "contacts/distance" in f)
    assert "0.5 m; where the bodies are, spheres of" in fault
