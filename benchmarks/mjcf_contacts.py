"""How well MuJoCo repeats rollouts of this engine with the exported MJCF: deviation 0.1 s after the first contact.

A cube is thrown onto the ground as `cgwm synthesize` would throw it, from many starts, for several frictions, contact
times and damping ratios. Each export is simulated as it is, and with MuJoCo's own contacts (no `pair`), whose friction
has the time constant of solref. With `--search`, the time constant of friction, the impedance, impratio, the friction,
the cone and friction found after the normal forces (`apart`) are varied, and each line shows one setting. Run with

    python benchmarks/mjcf_contacts.py [--starts 100] [--seed 1000] [--search] [--model MODEL]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from cgwm.datasets.models.mjcf import APART, APART_ITERATIONS, write_mjcf
from cgwm.datasets.models.model import Model, read_model
from cgwm.datasets.shapes.ply import Splats
from cgwm.pipeline.export.mujoco_check import AFTER_CONTACT_S, FRAME_S, start_of
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.rollout import simulate
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.synthesize.start_states import Start
from cgwm.schemas import BodyModel, ContactParameters, Ground, ModelFile, Pose, Provenance, Solver

LAWS = ((0.4, 0.008, 0.3), (0.3, 0.005, 0.2), (0.6, 0.006, 0.2), (0.2, 0.008, 0.3), (0.5, 0.012, 0.5))
"""Friction [1], contact time [s] and damping ratio [1]; the rule of the export was chosen on eight others."""
CHOSEN_ON = (
    (0.2, 0.008, 0.3), (0.8, 0.008, 0.3), (0.4, 0.004, 0.3), (0.4, 0.008, 0.8),
    (0.4, 0.016, 0.3), (0.4, 0.008, 0.12), (0.8, 0.004, 0.6), (0.2, 0.016, 0.15),
)  # fmt: skip
"""Those eight, for `--search`."""
DURATION_S = 1.0
HALF_M, MASS_KG = 0.05, 0.37
SHARES = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0)
"""Time constants of friction that are searched, in contact times."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Case:
    """A model, its export in MuJoCo, and what this engine does from each start."""

    law: ContactParameters
    """The contact law."""
    loaded: Any
    """The export, compiled."""
    starts: list[Start]
    """The starts that touch something."""
    frames: list[int]
    """Frame of the comparison for each start."""
    position_m: np.ndarray
    """Position of the body there [m], shape (start, 3)."""
    quat_wxyz: np.ndarray
    """Orientation there, shape (start, 4)."""


def cube(friction: float, contact_time_s: float, damping_ratio: float) -> Model:
    """Return a cube of 27 collision spheres on a ground."""
    line = np.linspace(-0.9 * HALF_M, 0.9 * HALF_M, 3)
    centres = np.stack(np.meshgrid(line, line, line), -1).reshape(-1, 3)
    spheres = Splats(centres, np.full(27, 0.05 * HALF_M), np.full(27, 0.9), np.full((27, 3), 0.5))
    inertia = MASS_KG / 6 * (2 * HALF_M) ** 2
    body = BodyModel(
        name="cube",
        motion="free",
        mass_kg=MASS_KG,
        inertia_kg_m2=(inertia, inertia, inertia, 0, 0, 0),
        com_m=(0, 0, 0),
        photo_pose=Pose(position_m=(0, 0, HALF_M)),
    )
    law = ContactParameters(friction=friction, contact_time_s=contact_time_s, damping_ratio=damping_ratio)
    file = ModelFile(
        ground=Ground(),
        bodies=(body,),
        contact=law,
        parameters=(),
        solver=Solver(step_s=0.0005),
        provenance=Provenance(capture="none"),
    )
    return Model(root=None, file=file, body_splats={}, collision={"cube": spheres}, scene=None)


def case_of(model: Model, seeds: range) -> Case:
    """Simulate a model with one free body from many starts in this engine."""
    times = np.arange(round(DURATION_S / FRAME_S) + 1) * FRAME_S
    starts = [start_of(model, seed, DURATION_S) for seed in seeds]
    parts = ("position_m", "quat_wxyz", "velocity_m_s", "omega_body_rad_s")
    state = State(*(torch.as_tensor(np.stack([getattr(s, part) for s in starts])).double() for part in parts))
    with torch.no_grad():
        world = world_of_model(model, torch.float64)
        ours = simulate(world, state, torch.as_tensor(times), starts[0].driven, record_contacts=True)
    assert ours.contacts is not None  # asked for above
    touching = (ours.contacts.impulse_n_s.numpy() != 0).any((2, 3))
    frames = [int(np.argmax(row)) + round(AFTER_CONTACT_S / FRAME_S) if row.any() else len(times) for row in touching]
    known = [k for k, frame in enumerate(frames) if frame < len(times)]
    at = [frames[k] for k in known]
    loaded = mujoco.MjModel.from_xml_string(write_mjcf(model))  # pyright: ignore[reportAttributeAccessIssue]
    loaded.opt.timestep = FRAME_S / np.ceil(FRAME_S / loaded.opt.timestep - 1e-9)
    assert model.file.contact is not None
    return Case(
        law=model.file.contact,
        loaded=loaded,
        starts=[starts[k] for k in known],
        frames=at,
        position_m=ours.position_m[known, at, 0].numpy(),
        quat_wxyz=ours.quat_wxyz[known, at, 0].numpy(),
    )


def deviation(case: Case, setting: Mapping[str, float]) -> tuple[float, float, float]:
    """Return median and 90 % quantile of the position [mm], and the median angle [deg], with changed contact numbers.

    Args:
        case: The case.
        setting: `soft` (the time constant of solref for friction, too), `share` (of the contact time), `impedance`,
            `impratio`, `friction` (a factor), `pyramid`, `apart` (normal forces before friction, as in files of
            slippery bodies); empty for the numbers of the file.
    """
    loaded, law = copy(case.loaded), case.law
    if setting:
        loaded.pair_solimp[:, :2] = setting.get("impedance", 0.99)
        loaded.pair_friction[:, :2] = law.friction * setting.get("friction", 1.0)
        share = setting.get("share", 1.0)
        loaded.pair_solreffriction[:] = (0.0, 0.0) if setting.get("soft") else (law.contact_time_s * share, 1.0)
        loaded.opt.impratio = APART if setting.get("apart") else setting.get("impratio", 1.0)
        loaded.opt.noslip_iterations = APART_ITERATIONS if setting.get("apart") else 0
        loaded.opt.cone = 0 if setting.get("pyramid") else 1
    data = mujoco.MjData(loaded)  # pyright: ignore[reportAttributeAccessIssue]
    found = np.array([_simulated(loaded, data, *one) for one in zip(case.starts, case.frames, strict=True)])
    away_mm = 1e3 * np.linalg.norm(found[:, :3] - case.position_m, axis=1)
    cosine = np.abs((found[:, 3:] * case.quat_wxyz).sum(1)).clip(0, 1)
    angle = np.degrees(2 * np.arccos(cosine))
    return float(np.median(away_mm)), float(np.quantile(away_mm, 0.9)), float(np.median(angle))


def _simulated(loaded: Any, data: Any, start: Start, frame: int) -> np.ndarray:
    mujoco.mj_resetData(loaded, data)  # pyright: ignore[reportAttributeAccessIssue]
    data.qpos[:] = np.r_[start.position_m[0], start.quat_wxyz[0]]
    data.qvel[:] = np.r_[start.velocity_m_s[0], start.omega_body_rad_s[0]]
    mujoco.mj_step(loaded, data, frame * round(FRAME_S / loaded.opt.timestep))  # pyright: ignore[reportAttributeAccessIssue]
    return data.qpos.copy()


def settings(search: bool) -> list[dict[str, float]]:
    """Return what is compared."""
    if not search:
        return [{"soft": 1.0}, {}]
    others: list[dict[str, float]] = [{"friction": 1.2}, {"friction": 0.85}, {"impedance": 0.9, "impratio": 10.0}]
    apart = [{"apart": 1.0, "share": share} for share in (0.25, 0.5, 1.0)]
    return [{"soft": 1.0}, *({"share": share} for share in SHARES), *others, {"pyramid": 1.0}, *apart]


def main() -> int:
    """Print a line for each law and setting."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--search", action="store_true")
    parser.add_argument("--model", type=Path, help="a model with one free body, instead of the cubes")
    given = parser.parse_args()
    laws = CHOSEN_ON if given.search else LAWS
    models = [cube(*law) for law in laws] if given.model is None else [read_model(given.model)]
    for model in models:
        case = case_of(model, range(given.seed, given.seed + given.starts))
        law = case.law
        print(f"friction {law.friction:g}, contact time {1e3 * law.contact_time_s:g} ms, damping {law.damping_ratio:g}")
        for setting in settings(given.search):
            median, most, angle = deviation(case, setting)
            print(f"  {setting or 'as exported'}: {median:.1f} mm (90 %: {most:.1f}), {angle:.1f} deg", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
