"""Read a dataset with bop_toolkit's own readers and print what it holds, as JSON. Run in bop_toolkit's environment.

Argument: the dataset's directory. The model's corners are projected by K (R p + t), as the toolkit's document says, and
compared with the visible mask and the depth image.
"""

# pyright: reportMissingImports=false

import json
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
from bop_toolkit_lib import inout, misc, pycoco_utils
from bop_toolkit_lib.dataset import bop_scenewise

root = Path(sys.argv[1])
model = inout.load_ply(root / "models" / "obj_000001.ply")
inside, depth_off, images = [], [], 0
scenes = sorted(path for split in ("train", "val") for path in (root / split).iterdir())
for scene in scenes:
    infos = bop_scenewise.read_scene_infos(scene, read_image_ids=True, read_n_objects=True)
    whole = infos["has_mask"]
    coco = inout.load_json(scene / "scene_gt_coco.json") if whole else {"annotations": []}
    annotations = {(entry["image_id"], entry["category_id"]): entry for entry in coco["annotations"]}
    data = bop_scenewise.load_scene_data(scene, load_scene_gt_info=whole)
    for number in sorted(infos["image_ids"])[:: max(1, len(infos["image_ids"]) // 6)]:
        image = bop_scenewise.load_image_data(scene, number, load_gt=True, load_mask=whole, load_gt_info=whole)
        pose, K, mask = image["gt"][0], image["camera"]["cam_K"], image["mask_visib"][0] > 0
        if mask.sum() < 20:
            continue
        local = (pose["cam_R_m2c"] @ model["pts"].T + pose["cam_t_m2c"]).T
        pixels = np.round((local @ K.T)[:, :2] / local[:, 2:]).astype(int)
        seen = ((pixels >= 0) & (pixels < mask.shape[::-1])).all(1)
        inside.append(float(mask[pixels[seen, 1], pixels[seen, 0]].mean()))
        depth = image["im_depth"][mask]
        depth_off.append(float(max(local[:, 2].min() - depth.min(), depth.max() - local[:, 2].max(), 0.0)))
        images += 1
        if whole:
            fact = image["gt_info"][0]
            assert fact["px_count_visib"] == mask.sum() <= fact["px_count_all"] == (image["mask"][0] > 0).sum()
            runs = annotations[number, pose["obj_id"]]["segmentation"]
            assert (pycoco_utils.rle_to_binary_mask(runs) == mask).all()
            assert pycoco_utils.binary_mask_to_rle(mask) == runs
            assert data["scene_gt_info"][number][0]["visib_fract"] <= 1
info = inout.load_json(root / "models" / "models_info.json", keys_to_int=True)[1]
about = {
    "versions": {name: version(name) for name in ("bop_toolkit_lib", "numpy", "imageio")},
    "scenes": len(scenes),
    "whole_silhouettes": whole,
    "images_checked": images,
    "image_size": list(inout.load_cam_params(root / "camera.json")["im_size"]),
    "corners_on_mask": inside,
    "depth_beyond_model_mm": depth_off,
    "model_corners": len(model["pts"]),
    "model_faces": len(model["faces"]),
    "diameter_mm": info["diameter"],
    "diameter_by_toolkit_mm": float(misc.calc_pts_diameter(model["pts"])),
}
print(json.dumps(about))
