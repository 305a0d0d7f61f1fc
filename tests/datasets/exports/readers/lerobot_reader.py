"""Read a dataset with LeRobot's own LeRobotDataset and print what it holds, as JSON. Run in LeRobot's environment.

Arguments: the dataset's directory; an .npz to write the decoded frames, states and actions of each episode's first and
last frame to.
"""

# pyright: reportMissingImports=false

import json
import sys
from importlib.metadata import version

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data import DataLoader

root, out = sys.argv[1:]
dataset = LeRobotDataset("local/cgwm", root=root)
cameras = dataset.meta.camera_keys
last = [entry["dataset_to_index"] - 1 for entry in dataset.meta.episodes]
first = [entry["dataset_from_index"] for entry in dataset.meta.episodes]
arrays = {}
for name in ["observation.state", "action", "timestamp", "episode_index", "frame_index", *cameras]:
    arrays[name] = np.stack([np.asarray(dataset[index][name]) for index in sorted(first + last)])
np.savez(out, **arrays)
window = {name: [-1 / dataset.fps, 0.0] for name in ["observation.state", *cameras]}
clips = LeRobotDataset("local/cgwm", root=root, delta_timestamps=window, episodes=[1, 3])
batch = next(iter(DataLoader(clips, batch_size=4, shuffle=True)))
about = {
    "versions": {name: version(name) for name in ("lerobot", "torch", "torchvision", "av", "datasets", "numpy")},
    "backend": dataset.video_backend,
    "episodes": dataset.num_episodes,
    "frames": dataset.num_frames,
    "fps": dataset.fps,
    "tasks": list(dataset.meta.tasks.index),
    "shapes": {name: list(shape) for name, shape in dataset.meta.shapes.items()},
    "stats": {
        name: {key: np.ravel(value).tolist() for key, value in entry.items()}
        for name, entry in dataset.meta.stats.items()
    },
    "batch": {name: list(value.shape) for name, value in batch.items() if hasattr(value, "shape")},
    "clips": len(clips),
}
print(json.dumps(about))
