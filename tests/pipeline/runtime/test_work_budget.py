"""Work that cannot be finished is refused before it starts, and work that takes long is announced."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.evaluate.work import evaluation_parts
from cgwm.pipeline.phys_geo.work import fit_parts
from cgwm.pipeline.physics import world_of_model
from cgwm.pipeline.runtime import work_budget
from cgwm.pipeline.runtime.work_budget import ENDLESS_S, Part, motion_doubt, within_budget
from cgwm.pipeline.synthesize.shards import synthesize_shards
from cgwm.pipeline.synthesize.stage import synthesize
from cgwm.schemas import InputDataError, PhysConfig, SynthesizeConfig, UsageError
from helpers.small_model import small_model, write_small_model


def seconds(parts: list[Part]) -> float:
    return sum(part.seconds for part in parts)


@pytest.mark.parametrize(
    ("part", "said"),
    [
        (Part(what="x", seconds=1.01 * ENDLESS_S), r"about 30 days on this machine: 30 days for x(.|\n)*Next: less"),
        (Part(what="x", memory_bytes=1e18), r"x: this needs 890 PiB of memory(.|\n)*what this machine has"),
        (Part(what="x", disk_bytes=1e18), r"x: this writes 890 PiB(.|\n)*make room there"),
    ],
)
def test_what_cannot_be_finished_is_refused_with_its_numbers(part: Part, said: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=said), within_budget([part], "less.", tmp_path / "out"):
        raise AssertionError("not reached")


def test_slow_work_is_announced_and_done(caplog: pytest.LogCaptureFixture) -> None:
    done = []
    with caplog.at_level(logging.WARNING, "cgwm"):
        with within_budget([Part(what="x", seconds=10_900)], "less.", doubt=motion_doubt([600.0])):
            done.append(1)
        with within_budget([Part(what="y", seconds=3000)], "less."):
            done.append(2)
    (record,) = caplog.records
    assert record.getMessage() == (
        "this takes about 3 h on this machine: 3 h for x. an episode lasts 10 min: are the times in ms? Otherwise less."
    )
    assert done == [1, 2]


def test_a_check_inside_of_a_checked_command_is_left_out() -> None:
    with within_budget([], ""), within_budget([Part(what="x", seconds=1e12)], ""):
        pass


def test_the_memory_limit_is_that_of_the_machine_or_less() -> None:
    assert 1e8 < work_budget.memory_limit() <= work_budget._physical_bytes()


def episodes(count: int, end_s: float, frames: int = 50) -> list[Episode]:
    times = np.linspace(0.0, end_s, frames)
    track = Track(times, np.zeros((frames, 3)), np.tile([1.0, 0, 0, 0], (frames, 1)))
    return [Episode(f"{k}", {"cube": track}) for k in range(count)]


def test_ordinary_work_is_minutes_at_most_and_absurd_work_is_endless() -> None:
    world = world_of_model(small_model())
    usual = PhysConfig()
    assert seconds(fit_parts(world, [0.8] * 50, usual)) < 600
    assert seconds(evaluation_parts(world, episodes(10, 600.0), 10)) < 3600  # ten minutes are a legitimate capture
    absurd = {
        "generations": fit_parts(world, [0.8] * 3, usual.model_copy(update={"generations": 10**9})),
        "population": fit_parts(world, [0.8] * 3, usual.model_copy(update={"population": 10**9})),
        "step": fit_parts(replace(world, step_s=1e-9), [0.8] * 3, usual),
        "time": evaluation_parts(world, episodes(3, 1e9), 3),
        "sweeps": evaluation_parts(replace(world, iterations=10**9), episodes(3, 0.5), 3),
    }
    short = {name: seconds(parts) for name, parts in absurd.items() if seconds(parts) < ENDLESS_S}
    assert not short


@pytest.mark.parametrize(
    "change",
    [{"rollouts": 10**9}, {"duration_s": 1e9}, {"frame_rate_hz": 1e12}, {"width": 10**6, "height": 10**6}],
    ids=str,
)
def test_an_absurd_dataset_is_refused_before_it_is_allocated(change: dict[str, float], tmp_path: Path) -> None:
    model = write_small_model(tmp_path / "model")
    config = SynthesizeConfig(device="cpu").model_copy(update=change)  # the schema may refuse some of them earlier
    with pytest.raises(UsageError, match=r"this (needs|writes|would take)"):
        synthesize(model, tmp_path / "out", config)
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def test_an_absurd_number_of_shards_is_refused(tmp_path: Path) -> None:
    model = write_small_model(tmp_path / "model")
    config = SynthesizeConfig(device="cpu").model_copy(update={"rollouts": 10**9, "shards": 10**9})
    with pytest.raises(UsageError, match=r"1e\+09 shards"):
        synthesize_shards(model, tmp_path / "out", config)


def test_no_rollout_has_more_steps_than_can_be_counted() -> None:
    world = replace(world_of_model(small_model()), step_s=1e-12)
    with pytest.raises(InputDataError, match=r"1 s of motion in steps of 1e-12 s are 1e\+12 steps"):
        world.substeps(torch.tensor([[0.0, 0.5, 1.0]]))
