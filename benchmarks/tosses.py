"""The real cube tosses: fitted to 200, evaluated on the 200 others, open loop, beside MuJoCo on the same tosses.

    python benchmarks/tosses.py

Each method is fitted as published (mass, inertia and centre of mass of the data set) and with the mass distribution
that `cgwm fit --set phys-geo.mass_distribution=true` finds in the training tosses. Initial states come from the same
warm-up rule: for MuJoCo too, from free flight with the same mass distribution. The last stage is an account of the
error that is left (`toss_account.py`). Nothing is chosen on the test tosses.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.importers.contactnets import HALF_WIDTH_M, INERTIA_KG_M2, RATE_HZ, import_contactnets
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.evaluate import evaluate
from cgwm.pipeline.fit import fit
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.schemas import PhysConfig
from mujoco_cube import NUMBERS, Rival, Tosses, cross_entropy, decoded
from numpy.typing import NDArray
from store import Store, shared_data
from toss_account import Account

Array = NDArray[np.float64]

MEAN_TRANSLATION_M, MEAN_ROTATION_DEG, FIT_SECONDS = 0.012, 13.0, 600.0
SEED = 0
POPULATION, GENERATIONS, ELITES = 32, 15, 8
"""Of MuJoCo's fit: 480 samples of all training tosses; the engine's search has 192."""
ACCOUNT_TOSSES = 100
"""So many of the test tosses are rolled out again and again for the account."""
OURS, RIVALS = "cgwm", ("mujoco, mass as published", "mujoco, mass as fitted", "cgwm, mass as published")


class Benchmark:
    """The capture and the models, made when a stage needs them; they are the same at equal seeds."""

    def __init__(self, tosses: Path, folder: Path) -> None:
        self._tosses, self._folder = tosses, folder
        self._models: dict[bool, Path] = {}

    def capture(self) -> Path:
        """Return the capture with 200 training and 200 test tosses, in the importer's permutation."""
        path = self._folder / "capture"
        if not path.is_dir():
            import_contactnets(self._tosses, path, n_train=200, n_test=200, seed=SEED)
        return path

    def model(self, mass_distribution: bool) -> Path:
        """Return a model fitted to the training tosses."""
        if mass_distribution not in self._models:
            path = self._folder / f"model-{int(mass_distribution)}"
            config = PhysConfig(seed=SEED, mass_distribution=mass_distribution)
            fit(self.capture(), path, phys_config=config)
            self._models[mass_distribution] = path
        return self._models[mass_distribution]

    def engine(self, mass_distribution: bool) -> dict[str, Any]:
        """Fit and evaluate the engine."""
        started, cpu = time.perf_counter(), time.process_time()
        parameters = read_model(self.model(mass_distribution)).file.parameters
        seconds = {"fit_wall_s": time.perf_counter() - started, "fit_cpu_s": time.process_time() - cpu}
        found = evaluate(self.model(mass_distribution), self.capture())
        return seconds | {
            "parameters": {p.name: (p.estimate, p.std_error) for p in parameters},
            "tosses": [e.episode for e in found.per_episode],
            "translation_error_m": [e.translation_error_m for e in found.per_episode],
            "rotation_error_deg": [e.rotation_error_deg for e in found.per_episode],
            "state_noise_floor_m": found.state_noise_floor_m and found.state_noise_floor_m.model_dump(),
            "state_fitted_residual_m": found.state_fitted_residual_m and found.state_fitted_residual_m.model_dump(),
        }

    def rival(self, mass_distribution: bool) -> dict[str, Any]:
        """Fit and evaluate MuJoCo with the engine's mass distribution, or with that of the data set."""
        _, train = self._rival(mass_distribution, "train")
        started, cpu = time.perf_counter(), time.process_time()
        best, history = cross_entropy(train, POPULATION, GENERATIONS, ELITES, SEED)
        seconds = {"fit_wall_s": time.perf_counter() - started, "fit_cpu_s": time.process_time() - cpu}
        names, test = self._rival(mass_distribution, "test")
        translation, rotation = test.errors(best)
        return seconds | {
            "parameters": dict(zip([n.name for n in NUMBERS], decoded(best).tolist(), strict=True)),
            "history_m": history,
            "tosses": names,
            "translation_error_m": translation.tolist(),
            "rotation_error_deg": rotation.tolist(),
        }

    def _rival(self, mass_distribution: bool, split: str) -> tuple[list[str], Rival]:
        world = world_of_model(read_model(self.model(True)))
        if not mass_distribution:  # the states are estimated in flight, where the contact does not matter
            inertia = INERTIA_KG_M2 * torch.eye(3).to(world.gravity)[None]
            world = world.with_body(0, com=torch.zeros(1, 3).to(world.gravity), inertia=inertia)
        account = Account.of(world, Capture.open(self.capture()), split)
        seen, body = account.observations, world.bodies[0]
        counts = seen.frames.tolist()
        tosses = Tosses(
            RATE_HZ,
            [row[:n, 0].numpy() for row, n in zip(seen.position_m, counts, strict=True)],
            [row[:n, 0].numpy() for row, n in zip(seen.quat_wxyz, counts, strict=True)],
            account.warm.sum(1).tolist(),
            np.concatenate([getattr(seen.state, key)[:, 0].numpy() for key in seen.state.__dataclass_fields__], axis=1),
        )
        matrix = body.inertia[0].numpy()
        six = [*matrix.diagonal(), matrix[0, 1], matrix[0, 2], matrix[1, 2]]
        return list(seen.names), Rival(tosses, (HALF_WIDTH_M,) * 3, float(body.mass[0]), six, body.com[0].tolist())

    def account(self) -> dict[str, Any]:
        """Say what the engine's error on the test tosses is made of."""
        world = world_of_model(read_model(self.model(True)))
        return Account.of(world, Capture.open(self.capture()), "test", ACCOUNT_TOSSES).report(SEED)


def summary(row: dict[str, Any]) -> str:
    """Return means and medians of a method in one line."""
    mm, deg = 1e3 * np.array(row["translation_error_m"]), np.array(row["rotation_error_deg"])
    return (
        f"{mm.mean():.2f} / {np.median(mm):.2f} mm, {deg.mean():.2f} / {np.median(deg):.2f} deg"
        f" (fit {row['fit_cpu_s']:.0f} s of CPU time)"
    )


def compared(row: dict[str, Any], other: dict[str, Any]) -> str:
    """Return the difference of two methods toss by toss: mean with standard error, and the share that `row` wins."""
    assert row["tosses"] == other["tosses"]
    parts = []
    for key, unit, factor in (("translation_error_m", "mm", 1e3), ("rotation_error_deg", "deg", 1.0)):
        difference = factor * (np.array(row[key]) - np.array(other[key]))
        error = difference.std(ddof=1) / np.sqrt(len(difference))
        parts.append(f"{difference.mean():+.2f} +- {error:.2f} {unit}, {np.mean(difference < 0):.0%} won")
    return "; ".join(parts)


def main() -> int:
    """Print one JSON line a stage and a table; return 1 if a figure misses its bar."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    data = shared_data()
    if data is None:
        print("no measured data: set CGWM_SHARED_DATA", file=sys.stderr)
        return 2
    store = Store("tosses")
    with tempfile.TemporaryDirectory() as folder:
        run = Benchmark(data / "cube_tosses", Path(folder))
        rows = {OURS: store.result(f"200: {OURS}", lambda: run.engine(True))}
        rows[RIVALS[0]] = store.result(f"200: {RIVALS[0]}", lambda: run.rival(False))
        store.result("200: account", run.account)
        rows[RIVALS[1]] = store.result(f"200: {RIVALS[1]}", lambda: run.rival(True))
        rows[RIVALS[2]] = store.result(f"200: {RIVALS[2]}", lambda: run.engine(False))
    for name, row in rows.items():
        print(f"{name}: {summary(row)}")
    for name in RIVALS:
        print(f"{OURS} against {name}, toss by toss: {compared(rows[OURS], rows[name])}")
    ours = rows[OURS]
    good = np.mean(ours["translation_error_m"]) < MEAN_TRANSLATION_M and ours["fit_cpu_s"] < FIT_SECONDS
    return 0 if good and np.mean(ours["rotation_error_deg"]) < MEAN_ROTATION_DEG else 1


if __name__ == "__main__":
    sys.exit(main())
