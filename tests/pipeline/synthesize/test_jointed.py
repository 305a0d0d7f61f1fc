"""Rollouts of jointed bodies: how they begin, their labels, what `validate` finds, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import mujoco
import numpy as np
import pytest
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.models.model import Model, write_model
from cgwm.datasets.rollouts.dataset import shard_name
from cgwm.pipeline.synthesize import synthesize
from cgwm.pipeline.synthesize.parameters import draw_parameters, settable, with_parameter
from cgwm.pipeline.synthesize.plan import resolve_plan
from cgwm.pipeline.synthesize.start_states import draw_start
from cgwm.pipeline.validate import validate
from cgwm.schemas import InputDataError, SamplingPlan, SynthesizeConfig
from helpers.jointed_model import HEIGHT_M, RADIUS, jointed_model

LIMITS = (-0.5, 1.0)


def made(path: Path, model: Model, **more: object) -> Path:
    write_model(path / "model", model)
    config = SynthesizeConfig.model_validate({"rollouts": 2, "duration_s": 0.4, "device": "cpu", **more})
    synthesize(path / "model", path / "data", config)
    return path / "data"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("jointed"), jointed_model(limits=LIMITS, cube=True))


@pytest.mark.parametrize("start", ["throw", "rest", "slide"])
def test_links_begin_on_their_joints_above_the_ground(start: str) -> None:
    model = jointed_model(limits=LIMITS, cube=True)
    plan = resolve_plan(model, SamplingPlan(start=start))  # pyright: ignore[reportArgumentType]
    for seed in range(10):
        began = draw_start(model, plan, 1.0, np.random.default_rng(seed))
        place = dict(zip(("cube", "upper", "lower"), began.position_m, strict=True))
        assert np.linalg.norm(place["lower"] - place["upper"]) == pytest.approx(0.1)
        if start == "rest":
            assert not began.velocity_m_s.any()
            assert place["upper"][2] > RADIUS - 1e-9
        if start == "throw":
            assert began.omega_body_rad_s[2] @ [1, 0, 1] != 0


def test_a_door_on_a_fixed_root_begins_between_its_limits_and_stays_there(tmp_path: Path) -> None:
    path = made(tmp_path, jointed_model("fixed", LIMITS), rollouts=1)
    assert validate(path).passed
    with h5py.File(path / shard_name(0, 1)) as file:
        demo = file["data/demo_0"]
        assert LIMITS[0] < demo["joints/pos"][0, 0] < LIMITS[1]
        np.testing.assert_array_equal(demo["bodies/pos"][:, 0], np.broadcast_to([0, 0, HEIGHT_M], (13, 3)))
        assert demo["joints/vel"][:, 0].std() > 0.1
        assert demo["states"].shape == (13, 3)


def test_the_labels_have_joints_and_materials_and_are_the_states_of_the_mjcf(data: Path) -> None:
    with h5py.File(data / shard_name(0, 1)) as file:
        demo = file["data/demo_1"]
        assert demo["joints/names"][()].tolist() == [b"elbow"]
        assert demo["joints/links"][()].tolist() == [b"lower"]
        assert demo["joints/kinds"][()].tolist() == [b"hinge"]
        assert demo["bodies/motions"][()].tolist() == [b"free", b"link", b"link"]
        assert demo["bodies/materials"][()].tolist() == [b"", b"wood", b"wood"]
        model = mujoco.MjModel.from_xml_string(demo.attrs["model_file"])
        state, rows = mujoco.MjData(model), demo["states"][()]
        for frame in (0, len(rows) - 1):
            state.qpos[:], state.qvel[:] = rows[frame, 1 : 1 + model.nq], rows[frame, 1 + model.nq :]
            mujoco.mj_forward(model, state)
            for k, name in enumerate(("cube", "upper", "lower")):
                np.testing.assert_allclose(state.body(name).xpos, demo["bodies/pos"][frame, k], atol=1e-9)
                velocity = np.zeros(6)
                mujoco.mj_objectVelocity(model, state, mujoco.mjtObj.mjOBJ_XBODY, state.body(name).id, velocity, 1)
                np.testing.assert_allclose(velocity[:3], demo["bodies/omega_body"][frame, k], atol=1e-8)


def test_parameters_of_joints_and_links_are_drawn_and_set() -> None:
    file = jointed_model().file
    drawn, listed = draw_parameters(file, 1.0, np.random.default_rng(0))
    values = {entry.name: entry.value for entry in listed}
    assert drawn.articulations[0].joints[0].damping == values["elbow.damping"] != 1e-4
    masses = [sum(body.mass_kg for body in one.bodies) for one in (file, drawn)]
    assert masses[0] == pytest.approx(masses[1])
    ratio = (drawn.bodies[1].mass_kg / drawn.bodies[0].mass_kg) / (0.3 / 0.2)
    assert ratio == pytest.approx(values["lower.mass_factor"] / 1.2)
    heavier = with_parameter(file, "arm.inertia_factor", 1.8)
    assert heavier.bodies[0].inertia_kg_m2[1] == pytest.approx(2 * 2e-4)
    assert heavier.bodies[0].mass_kg == 0.2
    assert {"elbow.damping", "elbow.friction"} <= set(settable(file))
    still = with_parameter(file, "elbow.friction", 0.02)
    assert still.articulations[0].joints[0].friction == 0.02


def test_validate_accepts_the_labels_and_finds_what_is_wrong_with_joints(data: Path, tmp_path: Path) -> None:
    report = validate(data)
    assert report.faults == ()
    assert report.facts["jointed_impulse_excess_share"] < 0.05

    def bent(demo: h5py.Group) -> None:
        demo["joints/pos"][3, 0] += 1e-4

    def late(demo: h5py.Group) -> None:
        demo["joints/vel"][2, 0] *= 1.01

    def moved(demo: h5py.Group) -> None:
        demo["bodies/pos"][1, 2, 1] += 1e-3

    def renamed(demo: h5py.Group) -> None:
        demo["joints/names"][0] = b"wrist"

    def lost(demo: h5py.Group) -> None:
        del demo["joints/vel"]

    def weak(demo: h5py.Group) -> None:
        rows = demo["contacts/body_a"][()] > 0
        demo["contacts/impulse_world"][rows] = 0.5 * demo["contacts/impulse_world"][()][rows]

    changes: dict[str, Callable[[h5py.Group], None]] = {
        "states: frame 3: differs from the times and the free bodies' and joints' poses": bent,
        "bodies/quat_wxyz: frame 3: link 'lower' is": bent,
        "bodies/vel: frame 2: link 'lower' is": late,
        "bodies/pos: frame 1: link 'lower' is": moved,
        "joints/names: wrist; the dataset's model has elbow": renamed,
        "joints/vel: this array is missing": lost,
        "contacts/impulse_world: body 'arm'": weak,
    }
    for number, (words, change) in enumerate(changes.items()):
        found = _changed(data, tmp_path / str(number), change)
        assert any(words in fault for fault in found), (words, found)


def _changed(data: Path, out: Path, change: Callable[[h5py.Group], None]) -> tuple[str, ...]:
    """Return what is found in a copy with a change, whose hash is kept right."""
    import shutil

    shutil.copytree(data, out)
    name = shard_name(0, 1)
    with h5py.File(out / name, "r+") as file:
        change(file["data/demo_1"])
    manifest = json.loads((out / "dataset.json").read_text("utf-8"))
    manifest["shards"][0] |= {"sha256": sha256(out / name), "bytes": (out / name).stat().st_size}
    (out / "dataset.json").write_text(json.dumps(manifest), encoding="utf-8")
    return validate(out).faults


def test_what_cannot_start_is_refused(tmp_path: Path) -> None:
    driven = jointed_model("driven")
    with pytest.raises(InputDataError, match="the root 'upper' of the jointed body 'arm' is driven"):
        made(tmp_path / "driven", driven)
    model = jointed_model()
    joint = model.file.articulations[0].joints[0].model_copy(update={"kind": "slide"})
    entry = model.file.articulations[0].model_copy(update={"joints": (joint,)})
    endless = replace(model, file=model.file.model_copy(update={"articulations": (entry,)}))
    with pytest.raises(InputDataError, match="the slide 'elbow' has no limits, so its start cannot be drawn"):
        made(tmp_path / "slide", endless)


def test_models_with_joints_are_simulated_by_validate(tmp_path: Path) -> None:
    write_model(tmp_path / "model", jointed_model())
    report = validate(tmp_path / "model")
    assert report.passed
    assert "simulated" not in report.facts
