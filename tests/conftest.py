"""What all tests share."""

import os
import sys
from collections.abc import Iterator

import pytest

# Tests start commands in processes of their own, from the repository's root. Without this Python puts that directory
# first on the path, and finds the folder cgwm/ there instead of the installed package.
os.environ["PYTHONSAFEPATH"] = "1"


def pytest_configure(config: pytest.Config) -> None:
    """Watch the processor time of the tests."""
    from helpers.processor_time import ProcessorTime

    config.pluginmanager.register(ProcessorTime(config))


@pytest.fixture(scope="session", autouse=True)
def _state_home(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What a user consents to is kept in the home directory: not that of the user who runs the tests."""
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Torch with one thread: the tensors of tests are too small to share out, and sums then repeat themselves."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def pytest_collection_finish() -> None:
    """Build the kernels of fits and rollouts with fewer optimisations; tests of the kernels themselves undo it.

    Nor for vectors of rollouts, which change no bit, as another test says, and take the compiler four times as long.

    No tensor of a test is spread over machines; what torch loads to see that takes two seconds of each worker.
    """
    if "torch" in sys.modules:
        import torch.testing._comparison

        torch.testing._comparison._HAS_DTENSOR = False
    if "cgwm.pipeline.physics.fused.host" in sys.modules:
        from cgwm.pipeline.physics.fused import host
        from helpers.fused_host import QUICK_FLAGS

        host.FLAGS, host.width = QUICK_FLAGS, lambda: 0


LONGEST = (
    "test_fused.py", "test_diagnosis.py", "test_calibrate.py", "test_shards.py", "test_export.py", "test_compare.py",
    "test_fuzz.py", "test_effects.py", "test_validate.py", "test_scenes.py", "test_fused_surfaces.py",
    "test_slow_errors.py", "test_robot_exports.py", "test_physics.py", "test_view.py", "test_laws.py",
    "test_synthesize.py", "test_mystery.py", "test_sg_gs.py", "test_fused_chains.py", "test_interrupt.py",
    "test_chains.py", "test_trust.py", "test_phys_images.py", "test_diagnosis_glides.py", "test_collision.py",
    "test_separation.py", "test_fit_effects.py", "test_video_input.py", "test_articulation.py", "test_published.py",
    "test_preview.py", "test_outputs.py", "test_resume.py", "test_visual_collision.py", "test_checkpoint.py",
    "test_dataset_structure.py", "test_estimation.py", "test_checks.py", "test_architecture.py",
    "test_diagnosis_impacts.py", "test_workers.py", "test_shooting.py",
)  # fmt: skip
"""Files that take 4 s or more of one core, the longest first."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest: workers take whole files, and none is to be left alone with one."""
    place = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.name, len(LONGEST)))
