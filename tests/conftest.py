"""What all tests share."""

import os
from collections.abc import Iterator

import pytest

# Tests start commands in processes of their own, from the repository's root. Without this Python puts that directory
# first on the path, and finds the folder cgwm/ there instead of the installed package.
os.environ["PYTHONSAFEPATH"] = "1"


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Torch with one thread: the tensors of tests are too small to share out, and sums then repeat themselves."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
