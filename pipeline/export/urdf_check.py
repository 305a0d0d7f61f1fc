"""URDF files that were written, opened in MuJoCo: where their links are at random values of the joints."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from ...datasets.exports.urdf import WORLD
from ...datasets.models.model import Model
from .chain_places import Places, chain_places, deviation

mujoco: Any = importlib.import_module("mujoco")  # it has no type stubs


def urdf_deviation(model: Model, folder: Path, seed: int) -> tuple[float, float]:
    """Return how far links of jointed bodies are in MuJoCo from where they are here, relative to the root.

    Every file is opened, those of rigid bodies and of the scene, too.

    Returns:
        The largest distance of the origins of links [mm], and the largest angle between them [deg].
    """
    rng, worst = np.random.default_rng(seed), (0.0, 0.0)
    expected = {one.name: chain_places(model, one, rng) for one in model.file.articulations}
    for path in sorted(folder.glob("*.urdf")):
        loaded = open_urdf(path)
        wanted = expected.get(path.stem)
        if wanted is not None:
            found = deviation(_relative(loaded, wanted), wanted.places)
            worst = max(worst[0], found[0]), max(worst[1], found[1])
    return worst


def open_urdf(path: Path) -> Any:
    """Return a URDF as a `mujoco.MjModel`, with all of its links."""
    root = ET.fromstring(path.read_text(encoding="utf-8"))
    extension = ET.SubElement(root, "mujoco")
    # without these MuJoCo joins links that do not move, and drops the names of folders of meshes
    flags = {"fusestatic": "false", "strippath": "false", "discardvisual": "true", "meshdir": str(path.parent)}
    ET.SubElement(extension, "compiler", flags)
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def _relative(loaded: Any, wanted: Places) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the poses of the links relative to the root at the joints' values."""
    data = mujoco.MjData(loaded)
    for name, value in wanted.joints.items():
        data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(loaded, data)
    names = [loaded.body(k).name for k in range(loaded.nbody)]
    # the root of a file without the link `world` is MuJoCo's own world
    held = {WORLD: 0} | {name: k for k, name in enumerate(names) if k}
    root = held.get(wanted.root, 0)
    place, turn = data.xpos[root], data.xmat[root].reshape(3, 3)
    return {
        name: (turn.T @ (data.xpos[held.get(name, 0)] - place), turn.T @ data.xmat[held.get(name, 0)].reshape(3, 3))
        for name in wanted.places
    }
