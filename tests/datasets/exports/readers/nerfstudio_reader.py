"""Read transforms.json with nerfstudio's own data parser and print what it holds, as JSON. Run in its environment.

Arguments: the directory; an .npz to write to: for each frame its image, depth, mask and the ray of every pixel that the
.npz `points` (third argument: pixel x and y by frame) names.
"""

# pyright: reportMissingImports=false

import json
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.utils.data_utils import get_depth_image_from_path

root, out, asked = map(Path, sys.argv[1:])
config = NerfstudioDataParserConfig(
    data=root,
    orientation_method="none",
    center_method="none",
    auto_scale_poses=False,
    eval_mode="all",
    downscale_factor=1,
    load_3D_points=False,
)
outputs = config.setup().get_dataparser_outputs("train")
dataset = InputDataset(outputs)
pixels = np.load(asked)
names, arrays = [], {}
for number, file in enumerate(outputs.image_filenames):
    name = file.relative_to(root / "images").as_posix()
    x, y = pixels[name]
    rays = outputs.cameras.generate_rays(number, coords=torch.tensor([[y, x]], dtype=torch.float32))
    height, width = int(outputs.cameras.height[number]), int(outputs.cameras.width[number])
    unit = outputs.metadata["depth_unit_scale_factor"]
    depth = get_depth_image_from_path(outputs.metadata["depth_filenames"][number], height, width, unit)
    item = dataset[number]
    arrays |= {f"{name}/image": item["image"].numpy(), f"{name}/depth": depth[..., 0].numpy()}
    arrays |= {f"{name}/origin": rays.origins[0].numpy(), f"{name}/direction": rays.directions[0].numpy()}
    if "mask" in item:
        arrays[f"{name}/mask"] = item["mask"][..., 0].numpy()
    names.append(name)
np.savez(out, **arrays)
about = {
    "versions": {name: version(name) for name in ("nerfstudio", "torch", "numpy")},
    "images": names,
    "scale": outputs.dataparser_scale,
    "transform": outputs.dataparser_transform.tolist(),
}
print(json.dumps(about))
