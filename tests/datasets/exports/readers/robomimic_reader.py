"""Read a shard with robomimic's own SequenceDataset and print what it holds, as JSON. Run in robomimic's environment.

Arguments: the shard; an .npz to write a few items to. robomimic does not know zstd: `import hdf5plugin` teaches HDF5.
"""

# pyright: reportMissingImports=false

import contextlib
import json
import sys
from importlib.metadata import version

import hdf5plugin  # noqa: F401
import numpy as np
from robomimic.utils import obs_utils
from robomimic.utils.dataset import SequenceDataset
from torch.utils.data import DataLoader

shard, out = sys.argv[1:]
low, pictures = ["object"], ["view0_image", "view1_image"]
with contextlib.redirect_stdout(sys.stderr):
    obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": low, "rgb": pictures, "depth": [], "scan": []}})
    made = {}
    for split in ("train", "valid"):
        made[split] = SequenceDataset(
            hdf5_path=shard,
            obs_keys=(*low, *pictures),
            dataset_keys=("actions", "rewards", "dones"),
            frame_stack=2,
            seq_length=4,
            hdf5_cache_mode="low_dim",
            filter_by_attribute=split,
            load_next_obs=True,
        )
    train = made["train"]
    items = {
        f"{k}/{group}/{name}": train[k][group][name]
        for k in (0, 7)
        for group in ("obs", "next_obs")
        for name in train.obs_keys
    }
    items |= {f"{k}/actions": train[k]["actions"] for k in (0, 7)}
    np.savez(out, **items)
    batch = next(iter(DataLoader(train, batch_size=4, shuffle=True, num_workers=0)))
shapes = {name: list(value.shape) for name, value in items.items()}
about = {
    "versions": {name: version(name) for name in ("robomimic", "torch", "h5py", "hdf5plugin", "numpy")},
    "demos": {split: list(map(str, dataset.demos)) for split, dataset in made.items()},
    "sequences": {split: len(dataset) for split, dataset in made.items()},
    "shapes": shapes,
    "batch": {name: list(value.shape) for name, value in batch["obs"].items()},
}
print(json.dumps(about))
