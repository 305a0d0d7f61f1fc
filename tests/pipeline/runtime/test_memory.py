"""Memory that does not suffice ends in one message: what was tried, where, and what needs less."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.pipeline import fit as fitting
from cgwm.pipeline.evaluate import stage as evaluation
from cgwm.pipeline.runtime.resources import enough_memory, ran_out_of_memory
from cgwm.pipeline.synthesize import stage as synthesis
from cgwm.schemas import NotEnoughMemoryError, SplatConfig, SynthesizeConfig
from helpers.small_model import write_small_model

OF_CUDA = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has a total capacity ...")


def raising(*arguments: object, **named: object) -> Any:
    raise OF_CUDA


@pytest.mark.parametrize("allocate", [lambda: torch.empty(10**15), lambda: np.empty(10**15)], ids=["torch", "numpy"])
def test_an_allocation_that_is_too_large_is_told_as_one(allocate: Callable[[], object]) -> None:
    with (
        pytest.raises(NotEnoughMemoryError) as caught,
        enough_memory("10 spheres", "cpu", "fewer spheres"),
    ):
        allocate()
    assert str(caught.value) == ("The memory did not suffice on the device 'cpu': 10 spheres.\nNext: fewer spheres.")
    assert caught.value.exit_code == 1


def test_only_a_lack_of_memory_is_told_as_one() -> None:
    assert ran_out_of_memory(OF_CUDA)
    assert ran_out_of_memory(RuntimeError("CUDA_ERROR_OUT_OF_MEMORY"))
    assert ran_out_of_memory(RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 8 bytes."))
    assert not ran_out_of_memory(ValueError("out of memory"))
    with pytest.raises(RuntimeError, match="shapes"), enough_memory("", "cpu", ""):
        raise RuntimeError("shapes do not match")


def test_fit_names_spheres_and_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "capture.toml").write_text('format = "cgwm-capture/1"\n[[bodies]]\nname = "ball"\n')
    monkeypatch.setattr(fitting, "fit_scene", raising)
    config = SplatConfig(spheres=100_000, image_size=960, device="cpu")
    with pytest.raises(NotEnoughMemoryError) as caught:
        fitting.fit(tmp_path, tmp_path / "model", "sg-gs", splat_config=config)
    assert str(caught.value) == (
        "The memory did not suffice on the device 'cpu': 100000 spheres of the background, 4000 a body, photos at "
        "960 px.\nNext: fewer spheres (--spheres N), smaller photos (--set sg-gs.image_size=N)."
    )
    assert not (tmp_path / "model").exists()


def test_another_device_is_named_where_there_is_one() -> None:
    with (
        pytest.raises(NotEnoughMemoryError, match=r"'cuda': x\.\nNext: y, or --device cpu\."),
        enough_memory("x", "cuda", "y"),
    ):
        raise OF_CUDA


def test_synthesize_names_spheres_and_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = write_small_model(tmp_path / "model")
    monkeypatch.setattr(synthesis, "draw_rollout", raising)
    config = SynthesizeConfig(rollouts=1, duration_s=0.1, width=64, height=48, device="cpu")
    with pytest.raises(NotEnoughMemoryError, match=r"'cpu': 800 spheres, pictures of 64x48 px\."):
        synthesis.synthesize(model, tmp_path / "dataset", config)
    assert not (tmp_path / "dataset").exists()


def test_eval_names_spheres(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = write_small_model(tmp_path / "model")
    monkeypatch.setattr(evaluation, "evaluate_model", raising)
    monkeypatch.setattr(Capture, "open", lambda *arguments, **named: None)
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "capture.toml").write_text('format = "cgwm-capture/1"\n')
    with pytest.raises(NotEnoughMemoryError, match="'cpu': 800 spheres"):
        evaluation.evaluate(model, tmp_path / "capture", device="cpu")
