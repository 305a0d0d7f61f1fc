"""A dataset in BOP's scenewise layout: one scene for each rollout, with all cameras and frames.

Source: bop_toolkit, docs/bop_datasets_format.md. Millimetres, OpenCV axes, and the top-left pixel's centre at (0, 0)
(`misc.depth_im_to_dist_im_fast` there), so that principal points are smaller by half a pixel. Objects are
numbered from 1 in the order of the bodies; the model frame is the body frame.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..capture.cameras import Camera
from ..capture.images import write_depth, write_image
from ..io.atomic import new_directory
from ..io.progress import progress
from ..rollouts.loader import RolloutReader
from .bop_coco import CocoScene
from .bop_models import ObjectModel, write_models
from .selection import Picture, Selection

DEPTH_STEPS_MM = (0.1, 1.0, 10.0)
"""Units of depth images [mm]; each image uses the finest unit that can represent its farthest pixel."""
SPLIT_FOLDERS = {"train": "train", "valid": "val"}
NO_AMODAL = (
    "the dataset has no amodal masks, so that mask/, scene_gt_info.json and scene_gt_coco.json are missing (visible "
    "fractions and whole silhouettes are not known); mask_visib/ is there"
)
_NOWHERE = [-1, -1, -1, -1]


def write_bop(
    path: Path, chosen: Selection, models: Mapping[str, ObjectModel], overwrite: bool = False
) -> tuple[dict[str, int], list[str]]:
    """Write `train/`, `val/`, `models/`, `camera.json` and `dataset_info.md`.

    Args:
        path: The directory to write.
        chosen: The dataset, its rollouts, cameras and frames. An image's number is frame * cameras + camera.
        models: The shape of each body, by name.
        overwrite: Replace what exists.

    Returns:
        Counts, and notes on what is left out.
    """
    folders = _split_folders(chosen)
    counts = {"scenes": 0, "images": 0, "instances": 0, "objects": len(models)}
    whole = True
    with new_directory(path, "BOP dataset", overwrite) as folder:
        write_models(folder / "models", list(models.values()))
        for number in progress(range(len(chosen)), "scenes", len(chosen), "scene"):
            info = chosen.reader.rollouts[number]
            scene = folder / folders[info.index] / f"{info.index:06d}"
            images, instances, amodal = _Scene(scene, chosen, number).write()
            counts["scenes"] += 1
            counts["images"] += images
            counts["instances"] += instances
            whole &= amodal
        _write_json(folder / "camera.json", _sensor(chosen.camera(0, chosen.cameras[0], 0)))
        (folder / "dataset_info.md").write_text(_description(chosen, models, whole), encoding="utf-8")
    return counts, [] if whole else [NO_AMODAL]


class _Scene:
    """One rollout as a scene."""

    def __init__(self, folder: Path, chosen: Selection, number: int):
        self.folder, self.chosen, self.number = folder, chosen, number
        self.position = chosen.reader.read(number, "bodies/pos")
        self.quat = chosen.reader.read(number, "bodies/quat_wxyz")
        self.cameras: dict[int, dict[str, Any]] = {}
        self.poses: dict[int, list[dict[str, Any]]] = {}
        self.facts: dict[int, list[dict[str, Any]]] = {}
        self.coco = CocoScene(chosen.bodies(number))

    def write(self) -> tuple[int, int, bool]:
        """Write the scene; return the numbers of images and instances, and whether amodal masks were available."""
        for kind in ("rgb", "depth", "mask_visib"):
            (self.folder / kind).mkdir(parents=True, exist_ok=True)
        whole = True
        for place, name in enumerate(self.chosen.cameras):
            for picture in self.chosen.pictures(self.number, name):
                image_id = picture.frame * len(self.chosen.cameras) + place
                self._image(image_id, self.chosen.camera(self.number, name, picture.frame), picture)
                whole &= picture.amodal is not None
        _write_json(self.folder / "scene_camera.json", self.cameras)
        _write_json(self.folder / "scene_gt.json", self.poses)
        if whole:
            _write_json(self.folder / "scene_gt_info.json", self.facts)
            text = json.dumps(self.coco.content())
            (self.folder / "scene_gt_coco.json").write_text(text + "\n", encoding="utf-8")
        return len(self.cameras), sum(map(len, self.poses.values())), whole

    def _image(self, image_id: int, camera: Camera, picture: Picture) -> None:
        T_cam_world = camera.T_cam_world
        step_mm = _depth_step(picture.depth_m)
        K = camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        self.cameras[image_id] = {
            "cam_K": K.ravel().tolist(),
            "depth_scale": step_mm,
            "cam_R_w2c": T_cam_world[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1e3 * T_cam_world[:3, 3]).tolist(),
        }
        name = f"{image_id:06d}"
        write_image(self.folder / "rgb" / f"{name}.png", picture.image)
        depth = np.round(picture.depth_m * (1e3 / step_mm))
        write_depth(self.folder / "depth" / f"{name}.png", np.where(depth > 65535, 0, depth).astype(np.uint16))
        self.poses[image_id], self.facts[image_id] = [], []
        self.coco.add_image(image_id, camera.width, camera.height)
        for body in range(self.position.shape[1]):
            R_world = Rotation.from_quat(self.quat[picture.frame, body], scalar_first=True).as_matrix()
            t_cam = T_cam_world[:3, :3] @ self.position[picture.frame, body] + T_cam_world[:3, 3]
            pose = {"cam_R_m2c": (T_cam_world[:3, :3] @ R_world).ravel().tolist(), "cam_t_m2c": (1e3 * t_cam).tolist()}
            self.poses[image_id].append({**pose, "obj_id": body + 1})
            visible = picture.mask == body + 1
            _write_mask(self.folder / "mask_visib" / f"{name}_{body:06d}.png", visible)
            if picture.amodal is not None:
                silhouette = picture.amodal[body] | visible
                (self.folder / "mask").mkdir(exist_ok=True)
                _write_mask(self.folder / "mask" / f"{name}_{body:06d}.png", silhouette)
                self.facts[image_id].append(_facts(visible, silhouette, picture.depth_m))
                self.coco.add(image_id, body, visible, silhouette)


def _facts(visible: NDArray[np.bool_], silhouette: NDArray[np.bool_], depth_m: NDArray[np.float32]) -> dict[str, Any]:
    """Return an entry of `scene_gt_info.json`; silhouettes are clipped at the image border."""
    total, seen = int(silhouette.sum()), int(visible.sum())
    return {
        "bbox_obj": _box(silhouette) if seen else _NOWHERE,
        "bbox_visib": _box(visible),
        "px_count_all": total,
        "px_count_valid": int((depth_m[silhouette] > 0).sum()),
        "px_count_visib": seen,
        "visib_fract": seen / total if total else 0.0,
    }


def _box(mask: NDArray[np.bool_]) -> list[int]:
    """Return x, y, width and height [px] of a mask, as bop_toolkit's `calc_2d_bbox` counts them."""
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        return _NOWHERE
    left, top = int(columns.min()), int(rows.min())
    return [left, top, int(columns.max()) - left, int(rows.max()) - top]


def _depth_step(depth_m: NDArray[np.float32]) -> float:
    farthest = float(depth_m.max(initial=0.0)) * 1e3
    return next((step for step in DEPTH_STEPS_MM if farthest / step < 65535), DEPTH_STEPS_MM[-1])


def _write_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    write_image(path, mask.astype(np.uint8) * 255)


def _split_folders(chosen: Selection) -> dict[int, str]:
    """Return the folder of each rollout, by its global index."""
    file = chosen.reader.group(0).file
    folders = {info.index: "train" for info in chosen.reader.rollouts}
    for split in file["mask"]:
        for info in RolloutReader(chosen.path, split).rollouts:
            folders[info.index] = SPLIT_FOLDERS.get(str(split), str(split))
    return folders


def _sensor(camera: Camera) -> dict[str, float]:
    K = camera.K
    focal = {"fx": float(K[0, 0]), "fy": float(K[1, 1]), "cx": float(K[0, 2]) - 0.5, "cy": float(K[1, 2]) - 0.5}
    return {**focal, "width": camera.width, "height": camera.height, "depth_scale": DEPTH_STEPS_MM[0]}


def _description(chosen: Selection, models: Mapping[str, ObjectModel], whole: bool) -> str:
    lines = [
        "# Exported by cgwm",
        "",
        "A scene is a rollout. Image number: frame * number of cameras + camera; cameras in this order: "
        + ", ".join(chosen.cameras)
        + ". Objects move within a scene, so views of different frames do not show the same scene.",
        "",
        "Millimetres; the top-left pixel's centre is (0, 0). The model frame is cgwm's body frame, not the middle of "
        "the bounding box. Depth is in steps of depth_scale, by image; 0 = none. Silhouettes (mask/) end at the "
        "image's edge.",
        "",
        *(f"- obj_{number:06d}: {name}; {model.origin}" for number, (name, model) in enumerate(models.items(), 1)),
    ]
    return "\n".join([*lines, *([] if whole else ["", NO_AMODAL + "."])]) + "\n"


def _write_json(path: Path, content: dict[Any, Any]) -> None:
    """Write one entry per line, keyed by number, as bop_toolkit does."""
    rows = [f'  "{key}": {json.dumps(content[key])}' for key in sorted(content)]
    path.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")
