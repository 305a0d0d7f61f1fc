"""What has to be refused of tasks of control, of models for them, and of their runs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py

from .edits import Edit, Row, field, text, written

CONTROL = ("control", "model", "task.toml", "--out", "OUT", "--clock", "ideal")
TASK, MODEL = "task.toml", "model/model.json"


def rows() -> Iterator[Row]:
    """Yield the tables."""
    for name, edit in TASKS:
        yield Row(f"task: {name}", "tasks", "task", edit, CONTROL)
    for name, words in WORDS:
        yield Row(f"control {name}", "tasks", "task", lambda root: None, (*CONTROL, *words.split()))
    for out in ("model", "docs", "task.toml"):
        words = ("control", "model", "task.toml", "--clock", "ideal", "--overwrite", "--out", out)
        yield Row(f"control --out {out}", "outputs", "task", written("docs/notes.txt", "mine"), words)
    for name, edit in HANDS:
        yield Row(f"hand: {name}", "hands", "hand", edit, CONTROL)
    for name, edit in RUNS:
        yield Row(f"run: {name}", "runs", "run", edit, ("validate", "run"))


def _without(name: str) -> Edit:
    def edit(root: Path) -> None:
        with h5py.File(root / "run" / "run.h5", "r+") as file:
            del file[f"data/demo_0/{name}"]

    return edit


def _without_scene(root: Path) -> None:
    text(TASK, 'kind = "model"', 'kind = "mujoco"')(root)
    (root / "scene.xml").unlink()


def _cut(root: Path) -> None:
    path = root / "run" / "run.h5"
    path.write_bytes(path.read_bytes()[:-100])


TASKS: tuple[tuple[str, Edit], ...] = (
    ("no TOML", written(TASK, "[planner\n")),
    ("empty numbers", field(TASK, "planner", "{ horizon_s = nan }")),
    ("an unknown section", field(TASK, "planer", "{ knots = 3 }")),
    ("an unknown joint", text(TASK, "joints = { x", "joints = { z = [0, 1], x")),
    ("zero gain", text(TASK, "stiffness_n_m = 2000.0", "stiffness_n_m = 0.0")),
    ("a horizon below a command", text(TASK, "horizon_s = 0.5", "horizon_s = 0.001")),
    ("a goal out of reach", text(TASK, "position_m = [0.0, 0.0]", "position_m = [9.0, 0.0]")),
    ("a finger in the ground", text(TASK, "height_m = 0.05", "height_m = 0.001")),
    ("a finger above", text(TASK, "height_m = 0.05", "height_m = 3.0")),
    ("an unknown object", text(TASK, "# object =", 'object = "kube"')),
    ("the object as robot", text(TASK, 'name = "tip"', 'name = "cube"')),
    ("a start in the finger", text(TASK, "# finger_m =", "position_m = [0.0, 0.0]\nfinger_m = [0.0, 0.0]")),
    ("MuJoCo without a mesh", text(TASK, 'kind = "model"', 'kind = "mujoco"')),
    ("a million samples of 60 s", text(TASK, "samples = 16", "samples = 1000000")),
    ("a format of the future", text(TASK, "cgwm-task/1", "cgwm-task/2")),
    ("a model without physics", field(MODEL, "contact", "null")),
    ("a model without ground", field(MODEL, "ground", "null")),
    ("a model whose object is fixed", field(MODEL, "bodies 0 motion", '"fixed"')),
)
HANDS: tuple[tuple[str, Edit], ...] = (
    ("no hand", lambda root: (root / "hand.xml").unlink()),
    ("a hand that is no MJCF", written("hand.xml", "<mujoco><worldbody>")),
    ("a hand without joints", written("hand.xml", "<mujoco><worldbody><body name='palm'/></worldbody></mujoco>")),
    ("a servo that does not exist", text("hand.xml", "<position", "<motor")),
    ("an unknown joint", text(TASK, "joints = {}", "joints = { swnig = 0.1 }")),
    ("an unknown link", text(TASK, "friction = {}", "friction = { thumb = 0.1 }")),
    ("a limit that is no range", text(TASK, "joints = {}", "joints = { swing = 9.0 }")),
    ("zero gain", text(TASK, "# stiffness =", "stiffness = 0.0")),
    ("a horizon below a command", text(TASK, "horizon_s = 0.4", "horizon_s = 0.001")),
    ("an object in the hand", text(TASK, "position_m = [0.0, 0.06, 0.05]", "position_m = [-0.03, 0.0, 0.035]")),
    ("no axis", text(TASK, "axis = [0.0, 0.0, 1.0]", "axis = [0.0, 0.0, 0.0]")),
    ("MuJoCo without its scene", _without_scene),
    ("a million samples of 60 s", text(TASK, "samples = 12", "samples = 1000000")),
    ("a format of the future", text(TASK, "cgwm-hand-task/1", "cgwm-hand-task/2")),
    ("a model without physics", field(MODEL, "contact", "null")),
)
WORDS = (
    ("without seeds", "--seeds 0"),
    ("with too many draws", "--draws 1000000"),
    ("with too many seeds", "--seeds 1000000000"),
    ("with an unknown solver", "--solver newton"),
)
RUNS: tuple[tuple[str, Edit], ...] = (
    ("another format", field("run/control.json", "format", '"cgwm-control/9"')),
    ("a page elsewhere", field("run/control.json", "page", '"../../x.html"')),
    ("a rate above 1", field("run/control.json", "success_rate", "1.5")),
    ("other successes", field("run/control.json", "successes", "2")),
    ("no recording", lambda root: (root / "run" / "run.h5").unlink()),
    ("a recording that was cut off", _cut),
    ("a recording without commands", _without("actions")),
    ("a recording without plans", _without("plans/targets")),
)
