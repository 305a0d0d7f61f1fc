"""Numbers of drawers that a finger pushes, drawn by seed: do the intervals of mass, losses and friction hold?

    python benchmarks/drawers.py FOLDER [--kind mujoco|rigid|spring] [--seed N] [--path_mm H] [--shape_mm S]
                                        [--without_forces] [--shoves]

Mass, friction and damping of the rail, frame rate, noise of all that is measured, what the file of the drawer says of
its mass, the error of the finger's radius and the noise of its path are drawn; `--path_mm` and `--shape_mm` set the
last two. `mujoco`: a body with a box, and a ball on a slow path that may slide along the face; the contact is stiff, or
soft so that it rings. `rigid` and `spring` are simulated here: a drawer that goes with the finger as long as it is
pushed, and one on a spring with a damper; nothing slides along them, so that nothing tells the friction of the finger.
Forces are samples there, and in MuJoCo means since the sample before. One JSON line for each number: what was true,
estimate and 95 % interval.

`--without_forces` leaves the forces out of the tracks. Motion then tells losses by mass alone: the true ones are those
of a drawer that has the mass that the file says. With `--shoves` the finger stops at once in the middle of its path, so
that the drawer glides on.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from cgwm.pipeline.fit import fit
from joints import COLUMNS, HEAD, force_of_finger, print_found, write_tracks
from scipy.spatial.transform import Rotation

HALF_M, CASE_M, RADIUS_M = (0.15, 0.15, 0.05), 0.3, 0.01
STEP_S, MUJOCO_STEP_S = 2e-5, 1e-4
SPRING_S, SPRING_DAMPING = 0.01, 0.2
"""Contact time and damping ratio of a spring."""
REST_S = 0.4
"""How long the finger stays after its motion."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What is drawn for a capture."""

    kind: str
    soft: bool
    """Whether the contact rings."""
    sliding: float
    """Speed of the finger along the face, relative to that of its push."""
    mass_kg: float
    stated_kg: float
    """Mass that the file says."""
    friction_n: float
    damping_n_s_m: float
    mu: float
    """Friction of the finger on the face."""
    rate_hz: float
    pushes: int
    position_std_m: float
    rotation_std_rad: float
    force_std_n: float
    path_std_m: float
    shape_m: float
    """How much larger the finger is in the file."""

    @staticmethod
    def drawn(rng: np.random.Generator, kind: str) -> Setting:
        """Draw one."""

        def log(low: float, high: float) -> float:
            return float(np.exp(rng.uniform(np.log(low), np.log(high))))

        mass = log(0.6, 5.0)
        return Setting(
            kind=kind,
            soft=bool(rng.integers(2)) if kind == "mujoco" else kind == "spring",
            sliding=float(rng.choice([0.0, rng.uniform(0.3, 1.0)])) if kind == "mujoco" else 0.0,
            mass_kg=mass,
            stated_kg=mass * float(rng.choice([1.0, log(0.8, 1.25)])),
            friction_n=log(1.0, 6.0),
            damping_n_s_m=log(1.0, 12.0),
            mu=float(rng.uniform(0.15, 0.5)),
            rate_hz=float(rng.choice([30.0, 60.0, 90.0, 120.0])),
            pushes=int(rng.integers(4, 13)),
            position_std_m=log(1e-4, 3e-4),
            rotation_std_rad=log(5e-4, 2e-3),
            force_std_n=log(0.02, 0.1),
            path_std_m=float(rng.choice([0.0, 1e-4, 3e-4])),
            shape_m=float(rng.choice([0.0, rng.uniform(-3e-4, 3e-4)])),
        )


@dataclass(frozen=True, kw_only=True)
class Push:
    """Motion of the finger: a smooth path of a length in a time, which starts at a gap from the face."""

    length_m: float
    time_s: float
    gap_m: float
    aside_m: float
    """Where the finger starts beside the middle of the face."""
    stops: float = 1.0
    """Share of the time at which it stops at once."""

    @staticmethod
    def drawn(rng: np.random.Generator) -> Push:
        """Draw one."""
        gap = float(rng.choice([0.0, rng.uniform(0.0, 0.01)]))
        return Push(
            length_m=float(rng.uniform(0.05, 0.2)),
            time_s=float(rng.uniform(0.7, 1.4)),
            gap_m=gap,
            aside_m=float(rng.uniform(-0.03, 0.03)),
        )

    def path(self, time_s: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return way, speed and acceleration at times: of least jerk (Flash and Hogan, 1985)."""
        share = np.asarray(time_s) / self.time_s
        s, moves = np.clip(share, 0.0, self.stops), share < self.stops
        way = self.length_m * s**3 * (10 - 15 * s + 6 * s**2)
        speed = self.length_m / self.time_s * 30 * s**2 * (1 - s) ** 2
        acceleration = self.length_m / self.time_s**2 * 60 * s * (1 - s) * (1 - 2 * s)
        return way, speed * moves, acceleration * moves


Motion = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Times (T,), places of the drawer (T,), of the finger's centre (T, 3), forces (T, 3) of a push."""


def by_hand(setting: Setting, push: Push) -> Motion:
    """Simulate a push: the drawer goes with the finger, or is on a spring and a damper at it."""
    count = round((push.time_s + REST_S) / STEP_S)
    every = round(1 / setting.rate_hz / STEP_S)
    time_s = STEP_S * np.arange(count + 1)
    way, speed, acceleration = (value.tolist() for value in push.path(time_s))
    m, f, d, gap = setting.mass_kg, setting.friction_n, setting.damping_n_s_m, push.gap_m
    k = m * (1 / SPRING_S if setting.soft else 1000.0) ** 2
    c = 2 * (SPRING_DAMPING if setting.soft else 1.0) * math.sqrt(k * m)
    q, w, rows = 0.0, 0.0, []
    for i in range(count + 1):
        deep = way[i] - gap - q
        if setting.soft:
            force = max(0.0, k * deep + c * (speed[i] - w)) if deep > 0 else 0.0
        else:  # the force that keeps the drawer at the finger
            force = max(0.0, m * acceleration[i] + f + d * speed[i]) if deep >= -1e-12 and speed[i] > 0 else 0.0
            if force > 0:
                q, w = way[i] - gap, speed[i]
        if i % every == 0:
            rows.append((time_s[i], q, way[i], force))
        if setting.soft or force == 0:
            push_n = force - d * w
            if abs(w) < 1e-9 and abs(push_n) <= f:
                w = 0.0
            else:
                sign = np.sign(w) if abs(w) >= 1e-9 else np.sign(push_n)
                after = w + STEP_S * (push_n - f * sign) / m
                w = 0.0 if after * sign < 0 else after
            q += STEP_S * w
    at, q, x, force = np.array(rows).T
    zero = np.zeros_like(x)
    finger = np.stack((-HALF_M[0] - RADIUS_M - gap + x, zero + push.aside_m, zero), 1)
    return at, q, finger, np.stack((force, zero, zero), 1)


def in_mujoco(setting: Setting, push: Push) -> Motion:
    """Simulate a push in MuJoCo: a finger whose speed is set in each step, a body with a box on a rail."""
    reference = f"-{100.0**2} -{2 * 0.2 * 100.0}" if setting.soft else "0.004 1"  # by mass
    half = " ".join(map(str, HALF_M))
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
      <option timestep="{MUJOCO_STEP_S}" integrator="implicitfast" gravity="0 0 0" cone="elliptic" impratio="10"/>
      <default><geom solref="{reference}" solimp="0.99 0.99 0.001"
        friction="{setting.mu} 0 0"/></default><worldbody>
      <body name="finger" pos="{-HALF_M[0] - RADIUS_M - push.gap_m} {push.aside_m} 0">
        <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
        <geom type="sphere" size="{RADIUS_M}" mass="1e4"/></body>
      <body name="drawer"><joint name="rail" type="slide" axis="1 0 0" damping="{setting.damping_n_s_m}"
        frictionloss="{setting.friction_n}" solreffriction="0.0005 1" solimpfriction="0.99 0.99 0.001"/>
        <geom type="box" size="{half}" mass="0"/>
        <inertial pos="0 0 0" mass="{setting.mass_kg}" diaginertia="0.02 0.02 0.02"/></body>
      </worldbody></mujoco>""")
    data, rows, exerted = mujoco.MjData(model), [], []
    every = round(1 / setting.rate_hz / MUJOCO_STEP_S)
    for step in range(round((push.time_s + REST_S) / MUJOCO_STEP_S) + 1):
        way, speed, _ = push.path(step * MUJOCO_STEP_S)
        for joint, share in (("x", 1.0), ("y", setting.sliding)):
            data.joint(joint).qpos[0], data.joint(joint).qvel[0] = share * way, share * speed
        mujoco.mj_forward(model, data)
        exerted.append(force_of_finger(model, data))
        if step % every == 0:
            mean = np.mean(exerted[-every:], 0)
            rows.append((data.time, data.joint("rail").qpos[0], data.body("finger").xpos.copy(), mean))
        mujoco.mj_step(model, data)
    at, q, finger, force = (np.array(column) for column in zip(*rows, strict=True))
    return at, q, finger, force


def track(rng: np.random.Generator, setting: Setting, motion: Motion, forces: bool) -> list[str]:
    """Return the rows of a track, with noise on what is measured."""
    rows = [COLUMNS + ",force_x_n,force_y_n,force_z_n"]
    for at, q, finger, force in zip(*motion, strict=True):
        place = np.array([q, 0.0, 0.0]) + setting.position_std_m * rng.standard_normal(3)
        quat = Rotation.from_rotvec(setting.rotation_std_rad * rng.standard_normal(3)).as_quat(scalar_first=True)
        path = finger + setting.path_std_m * rng.standard_normal(3)
        exerted = force + setting.force_std_n * rng.standard_normal(3)
        rows += [
            f"{at:.5f},case,0,0,0,1,0,0,0,,,",
            f"{at:.5f},drawer," + ",".join(f"{v:.6f}" for v in (*place, *quat)) + ",,,",
            ",".join(
                [f"{at:.5f},finger", *(f"{v:.6f}" for v in path), "1,0,0,0", *(f"{v:.4f}" for v in exerted)],
            ),
        ]
    return rows if forces else [row.rsplit(",", 3)[0] for row in rows]


def capture(folder: Path, setting: Setting, motions: list[list[str]]) -> Path:
    """Write the capture, all of whose episodes are for the fit."""
    names, box = write_tracks(folder, motions), " ".join(f"{2 * half:g}" for half in HALF_M)
    (folder / "body.urdf").write_text(f"""<robot name="cabinet">
  <link name="case"><collision><origin xyz="{CASE_M} 0 -0.2"/><geometry><box size="0.05 0.3 0.2"/></geometry>
  </collision></link><link name="drawer"><inertial><mass value="{setting.stated_kg}"/>
  <inertia ixx="0.02" iyy="0.02" izz="0.02"/>
  </inertial><collision><geometry><box size="{box}"/></geometry></collision></link>
  <joint name="rail" type="prismatic"><parent link="case"/><child link="drawer"/><axis xyz="1 0 0"/>
  <limit lower="-0.5" upper="0.5" effort="100" velocity="10"/></joint></robot>""")
    (folder / "capture.toml").write_text(
        f'{HEAD}[[bodies]]\nname = "finger"\nmotion = "driven"\n'
        f"shape = {{ sphere = {{ radius_m = {RADIUS_M + setting.shape_m} }} }}\n"
        '[[articulations]]\nname = "cabinet"\nurdf = "body.urdf"\nbase = "fixed"\n'
        "pose = { position_m = [0.0, 0.0, 0.0] }\n"
        f"[splits]\ntrain = {json.dumps(names)}\n"
    )
    return folder


def main() -> None:
    """Make the capture, fit it, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kind", choices=("mujoco", "rigid", "spring"), default="mujoco")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--path_mm", type=float)
    parser.add_argument("--shape_mm", type=float)
    parser.add_argument("--without_forces", action="store_true")
    parser.add_argument("--shoves", action="store_true")
    given = parser.parse_args()
    rng = np.random.default_rng([given.seed, ("mujoco", "rigid", "spring").index(given.kind)])
    drawn = asdict(Setting.drawn(rng, given.kind))
    drawn |= {} if given.path_mm is None else {"path_std_m": given.path_mm / 1e3}
    drawn |= {} if given.shape_mm is None else {"shape_m": given.shape_mm / 1e3}
    setting = Setting(**drawn)
    simulated = in_mujoco if given.kind == "mujoco" else by_hand
    forces, stops = not given.without_forces, 0.5 if given.shoves else 1.0
    pushes = (replace(Push.drawn(rng), stops=stops) for _ in range(setting.pushes))
    motions = [track(rng, setting, simulated(setting, push), forces) for push in pushes]
    made = capture(given.folder / "drawer", setting, motions)
    print(json.dumps({"seed": given.seed, **drawn}), flush=True)
    began = time.process_time()
    fit(made, given.folder / "model", overwrite=True)
    factor = setting.mass_kg / setting.stated_kg
    by_mass = 1.0 if forces else factor
    truth = {
        "cabinet.mass_factor": factor,
        "rail.friction": setting.friction_n / by_mass,
        "rail.damping": setting.damping_n_s_m / by_mass,
        "friction": setting.mu,
    }
    if setting.kind == "spring":
        truth |= {"contact_time_s": SPRING_S, "damping_ratio": SPRING_DAMPING}
    more = {"seed": given.seed, "kind": given.kind, "forces": forces, "cpu_s": round(time.process_time() - began, 1)}
    print_found(given.folder / "model", truth, more)


if __name__ == "__main__":
    main()
