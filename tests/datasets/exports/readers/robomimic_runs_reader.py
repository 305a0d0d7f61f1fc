"""Read runs of `cgwm control` with robomimic's own SequenceDataset and print what they hold, as JSON.

Arguments: run.h5; the names of its observations, with commas. Run in robomimic's environment.
"""

# pyright: reportMissingImports=false

import contextlib
import json
import sys

from robomimic.utils import obs_utils
from robomimic.utils.dataset import SequenceDataset

path, names = sys.argv[1], sys.argv[2].split(",")
with contextlib.redirect_stdout(sys.stderr):
    obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": names, "rgb": [], "depth": [], "scan": []}})
    found = {}
    for kept in (None, "success"):
        made = SequenceDataset(
            hdf5_path=path,
            obs_keys=names,
            dataset_keys=("actions", "rewards", "dones"),
            frame_stack=1,
            seq_length=3,
            hdf5_cache_mode="low_dim",
            filter_by_attribute=kept,
            load_next_obs=True,
        )
        found[str(kept)] = {"demos": list(map(str, made.demos)), "sequences": len(made)}
        item = made[1] if len(made) else None
        if item is not None:
            found[str(kept)]["shapes"] = {name: list(value.shape) for name, value in item["obs"].items()}
            found[str(kept)]["next_object"] = item["next_obs"]["object"][:, :3].tolist()
print(json.dumps(found))
