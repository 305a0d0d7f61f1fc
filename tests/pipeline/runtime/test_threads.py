"""One thread for torch's small tensors, all for the compiled kernels, and what was there before comes back."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from cgwm.pipeline.runtime.resources import kernel_threads, one_torch_thread


@pytest.fixture(autouse=True)
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def threads() -> tuple[int, int]:
    return torch.get_num_threads(), kernel_threads()


def test_torch_has_one_thread_and_kernels_have_all() -> None:
    assert threads() == (3, 3)
    with one_torch_thread():
        assert threads() == (1, 3)
        with one_torch_thread():
            assert threads() == (1, 3)
        with one_torch_thread(kernels_too=True):
            assert threads() == (1, 1)
            with one_torch_thread():
                assert threads() == (1, 1)
        assert threads() == (1, 3)
    assert threads() == (3, 3)


def test_threads_come_back_after_an_error_and_a_function_may_be_called_twice() -> None:
    @one_torch_thread()
    def fails() -> None:
        assert threads() == (1, 3)
        raise ValueError

    for _ in range(2):
        with pytest.raises(ValueError):
            fails()
        assert threads() == (3, 3)
