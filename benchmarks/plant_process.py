"""The plant of a hand in a process of its own, under another version of MuJoCo: commands in, states out by a pipe.

The process is this file, run by the same Python; `folder` holds the other version's packages, as `pip install --target`
makes it (with `--no-deps mujoco==3.2.0`, say), and comes first on its path.
"""

from __future__ import annotations

import importlib
import os
import pickle
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from cgwm.pipeline.control.hand.plant import HandScenePlant, HandTruth
from cgwm.pipeline.control.hand.world import HandWorld
from cgwm.pipeline.control.horizon import Array
from cgwm.schemas import NotConvergedError


class PipedPlant:
    """A `HandScenePlant` in a process of its own, which may serve one task after the other.

    Args:
        folder: Folder of packages that come before the installed ones.
    """

    def __init__(self, folder: Path) -> None:
        path = os.pathsep.join(part for part in (str(folder.resolve()), os.environ.get("PYTHONPATH", "")) if part)
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "MUJOCO_GL": "disable"},
        )  # fmt: skip

    def open(self, hand: HandWorld) -> str:
        """Take another task, and return the version of MuJoCo in the process."""
        task = hand.task
        return self._asked(("open", task, task._source, hand.joints, hand.home))

    def reset(self, position_m: Array, quat_wxyz: Array) -> HandTruth:
        """See `cgwm.pipeline.control.hand.plant.HandPlant`."""
        return self._asked(("reset", position_m, quat_wxyz))

    def advance(self, target_rad: Array, interval_s: float) -> HandTruth:
        """See `HandPlant`."""
        return self._asked(("advance", target_rad, interval_s))

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def _asked(self, question: Any) -> Any:
        assert self._process.stdin is not None and self._process.stdout is not None
        pickle.dump(question, self._process.stdin)
        self._process.stdin.flush()
        answer = pickle.load(self._process.stdout)
        if isinstance(answer, Exception):
            raise answer
        return answer


def main() -> None:
    """Answer until the pipe is closed."""
    answers, sys.stdout = sys.stdout.buffer, sys.stderr  # what libraries print must not enter the pipe
    plant = None
    while True:
        try:
            name, *arguments = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        answer: Any
        if name == "open":
            task, source, joints, home = arguments
            task._source = source
            hand: Any = SimpleNamespace(task=task, joints=joints, home=home)
            plant, answer = HandScenePlant(hand), importlib.import_module("mujoco").__version__
        else:
            try:
                answer = getattr(plant, name)(*arguments)
            except NotConvergedError as error:
                answer = error
        pickle.dump(answer, answers)
        answers.flush()


if __name__ == "__main__":
    main()
