"""One thread for torch's small tensors, all for the compiled kernels, and what was there before comes back."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from cgwm.pipeline.physics.fused.host import THREAD_CONTACT_STEPS, threads_for
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


@pytest.mark.parametrize(
    ("rollouts", "contact_steps", "expected"),
    [
        pytest.param(2, 100 * THREAD_CONTACT_STEPS, 2, id="a long rollout deserves a thread"),
        pytest.param(64, 100 * THREAD_CONTACT_STEPS, 3, id="all threads"),
        pytest.param(64, THREAD_CONTACT_STEPS // 32, 2, id="short ones share threads"),
        pytest.param(5, 1, 1, id="one at least"),
    ],
)
def test_a_kernel_takes_the_threads_that_its_work_is_worth(rollouts: int, contact_steps: int, expected: int) -> None:
    assert threads_for(rollouts, contact_steps) == expected
