"""Valid models and datasets: small, and made by our own engine and renderer."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from .captures import tracks


def model(root: Path) -> None:
    """Write a model with two bodies, an effect, correlations, a light and an exposure."""
    from cgwm.datasets.models.model import write_model
    from cgwm.schemas import Correlation, EffectModel, Exposure, Light, Solver
    from helpers.small_model import small_model, table_splats

    made = small_model(driven=True)
    change = {
        "effects": (EffectModel(name="quadratic_drag", parameters={"k": 0.001}),),
        "correlations": (Correlation(parameters=("friction", "damping_ratio"), matrix=((1.0, -0.5), (-0.5, 1.0))),),
        "exposures": {"left": Exposure(gain_rgb=(0.8, 0.9, 0.95))},
        "light": Light(lamp=(0.0, 0.0, 0.5), sky=0.1),
        "solver": Solver(step_s=0.004, sweeps=2),
    }
    known = {name: value for name, value in change.items() if name in type(made.file).model_fields}
    write_model(root / "model", replace(made, file=made.file.model_copy(update=known), scene=table_splats(8)))


CANARY = "CANARY"


def custom(root: Path) -> None:
    """Write a stranger's model with an effect of its own, which leaves a witness when it is run."""
    from cgwm.datasets.models.model import write_model
    from cgwm.schemas import EffectModel
    from helpers.small_model import small_model

    text = Path(__file__).parents[2].joinpath("pipeline/physics/effects/template.py").read_text(encoding="utf-8")
    text = text.replace("from .effect import", "from cgwm.pipeline.physics.effects import")
    source = root / "lift.py"
    source.write_text(f"{text}\n\nfrom pathlib import Path\n\nPath({str(root.resolve())!r}, {CANARY!r}).touch()\n")
    made = small_model()
    effect = EffectModel(name=f"{source}:MyEffect", parameters={"w": 0.5, "r": 0.2})
    write_model(root / "model", replace(made, file=made.file.model_copy(update={"effects": (effect,)})))
    source.unlink()
    tracks(root / "other")
    (root / "other" / "capture").rename(root / "capture")
    shutil.rmtree(root / "other")


def task(root: Path) -> None:
    """Write a model, and a task with plans so short that runs of it take a second."""
    from cgwm.schemas import task_toml
    from helpers.pushing import push_task

    model(root)
    (root / "task.toml").write_text(task_toml(push_task(success={"timeout_s": 0.1})), encoding="utf-8")


def hand(root: Path) -> None:
    """Write a model, a hand, and a task for it whose runs take a second."""
    from cgwm.schemas import task_toml
    from helpers.paddles import hand_task, write_hand

    model(root)
    write_hand(root)
    (root / "task.toml").write_text(task_toml(hand_task(root, success={"timeout_s": 0.1})), encoding="utf-8")


def run(root: Path) -> None:
    """Write runs of a task."""
    from cgwm.pipeline.control import control

    task(root)
    control(root / "model", root / "task.toml", root / "run", clock="ideal", seeds=2)


def dataset(root: Path) -> None:
    """Write a dataset of two rollouts with images."""
    synthesize_small(root, small=False)


def bare(root: Path) -> None:
    """Write a dataset of two rollouts without images."""
    synthesize_small(root, small=True)


def merged(root: Path) -> None:
    """Write a dataset of two shards, with its index."""
    from cgwm.pipeline.synthesize import merge
    from cgwm.pipeline.synthesize.shards import synthesize_shards
    from cgwm.schemas import SynthesizeConfig
    from helpers.small_model import write_small_model

    write_small_model(root / "model")
    config = SynthesizeConfig(rollouts=2, duration_s=0.2, width=48, height=36, shards=2)
    synthesize_shards(root / "model", root / "dataset", config)
    merge([root / "dataset"])


def synthesize_small(root: Path, small: bool) -> None:
    """Write a model and a dataset of two rollouts of it; small: without images."""
    from cgwm.pipeline.synthesize import synthesize
    from cgwm.schemas import SynthesizeConfig
    from helpers.small_model import write_small_model

    write_small_model(root / "model", visible=not small)
    synthesize(root / "model", root / "dataset", SynthesizeConfig(rollouts=2, duration_s=0.2, width=48, height=36))


def plan(root: Path) -> None:
    """Write a model and a sampling plan that has every kind of entry."""
    model(root)
    (root / "plan.toml").write_text(
        "height_m = [0.02, 0.15]\nhorizontal_speed_m_s = [0.0, 1.0]\nview_elevation_deg = { normal = [35.0, 5.0] }\n"
        "view_azimuth_deg = [0.0, 180.0]\nview_shift_deg = [-20.0, 20.0]\nlight_gain = [0.7, 1.2]\n"
        "exposure_gain = { log_uniform = [0.8, 1.25] }\nspin_rad_s = { choice = [0.0, 1.0] }\nparameter_spread = 2.0\n"
        '[reject]\nattempts = 20\noff_table_m = 5.0\n[parameters]\n"cube.mass_kg" = { choice = [0.2, 0.4] }\n'
    )
