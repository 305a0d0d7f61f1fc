"""Matches of pairs of photos by COLMAP, here or in a process of its own.

The descriptors are compared by a BLAS that pycolmap's wheels contain. It is built for one thread, without locks: two
calls at once may share a buffer, and the matches of the photos that are compared at that moment are others in one run
of five or so on a busy machine. So matches that are found side by side are found in processes, which start this file as
a script; it imports nothing but pycolmap.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pycolmap

_POLL_S = 0.05


def match_pairs(
    database: Path, pairs: Sequence[Sequence[str]], settings: dict[str, Any], cancellation_token: Any
) -> None:
    """Match pairs of photos in one thread, and verify the matches in another.

    Args:
        database: The database with the features, to which the matches are added.
        pairs: Names of photos.
        settings: Values of `seed`, `guided_matching`, `max_ratio` and `verification_trials`.
        cancellation_token: COLMAP's, which ends the matching early.
    """
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    matching.use_gpu = False
    matching.guided_matching = settings["guided_matching"]
    matching.sift.max_ratio = settings["max_ratio"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = settings["seed"]
    verification.ransac.num_threads = 1
    verification.ransac.max_num_trials = settings["verification_trials"]
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = Path(database).with_suffix(".pairs.txt")
    Path(pairing.match_list_path).write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    pycolmap.set_random_seed(settings["seed"])
    pycolmap.match_image_pairs(
        database_path=database,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
        cancellation_token=cancellation_token,
    )


def match_apart(
    database: Path, pairs: Sequence[Sequence[str]], settings: dict[str, Any], cancellation_token: Any
) -> None:
    """Do what `match_pairs` does in a process of its own, which ends when the token is cancelled.

    Raises:
        RuntimeError: If the process fails, with its last words.
    """
    task = Path(database).with_suffix(".task.json")
    task.write_text(json.dumps([str(database), pairs, settings]), encoding="utf-8")
    places = (str(Path(pycolmap.__file__).parent.parent), os.environ.get("PYTHONPATH", ""))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, places))}
    log = task.with_suffix(".log")
    with (
        log.open("wb") as words,
        subprocess.Popen(
            [sys.executable, "-P", __file__, str(task)],  # -P: this folder's modules do not stand in for others
            stdin=subprocess.PIPE,
            stdout=words,
            stderr=words,
            env=environment,
            start_new_session=True,  # Ctrl-C reaches the parent alone, which ends this one
        ) as process,
    ):
        try:
            while process.poll() is None:
                if cancellation_token.is_cancelled:
                    return
                with suppress(subprocess.TimeoutExpired):
                    process.wait(_POLL_S)
        finally:
            process.kill()
    if process.returncode != 0:
        last = "".join(log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:])
        raise RuntimeError(f"COLMAP's matching ended with code {process.returncode}: {last}")


def _with_parent() -> None:
    """End this process when its parent has ended, whose end of the pipe is closed then."""
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


if __name__ == "__main__":
    pycolmap.logging.minloglevel = 3
    threading.Thread(target=_with_parent, daemon=True).start()
    place, listed, values = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    match_pairs(Path(place), listed, values, pycolmap.CancellationToken())
