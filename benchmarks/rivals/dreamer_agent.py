"""DreamerV3's own agent (danijar/dreamerv3): trained on whole sequences, and asked what it imagines.

It observes the cameras' pictures and the object's state, and its actions are where the fingertip is and goes; rewards
are 0. Its actor and critic are trained with the rest and not used. Between what it observes and what its decoder says
nothing of ours stands.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .source import module

BATCH = 16
"""Sequences of a step: its own number."""
Arrays = Mapping[str, NDArray[Any]]


class Agent:
    """The agent.

    Args:
        folder: Its repository.
        data: Sequences (S, T, ...): image uint8 (H, W, C), state (18,), action (n,), reward, is_first, is_last,
            is_terminal.
        size: One of its own sizes, as `size12m`.
        platform: cpu or cuda.
        seed: Of everything that is drawn.
    """

    def __init__(self, folder: Path, data: Arrays, size: str, platform: str, seed: int) -> None:
        _by_name()
        self.data, self.seed, self.steps = data, seed, 0
        config = _config(folder, size, platform, seed, data["image"].shape[1])
        self.agent: Any = module("dreamerv3.agent").Agent(*_spaces(data), config)
        self.carry = self.agent.init_train(BATCH)
        self.draw = np.random.default_rng(seed)
        self._imagine: Any = None

    def size(self) -> int:
        """Return the number of its weights, without those that only the optimiser has."""
        return sum(v.size for name, v in self.agent.params.items() if not name.startswith(("opt/", "slowval/")))

    def train(self, seconds: float) -> dict[str, float]:
        """Train for so long, at least two steps, and return its last losses."""
        losses: dict[str, float] = {}
        end = time.perf_counter() + seconds
        while time.perf_counter() < end or not losses:
            self.carry, _, found = self.agent.train(self.carry, self._batch())
            losses = {name: float(value) for name, value in found.items() if name.startswith("loss/")}
            self.steps += 1
        return losses

    def _batch(self) -> dict[str, Any]:
        rows = self.draw.integers(0, len(self.data["image"]), BATCH)
        batch = {name: values[rows] for name, values in self.data.items()}
        shape = batch["reward"].shape
        batch |= {"consec": np.zeros(shape, np.int32), "stepid": np.zeros((*shape, 20), np.uint8)}
        placed = module("embodied.jax.internal").device_put(batch, self.agent.train_sharded)
        return {**placed, "seed": self.agent._seeds(self.steps, self.agent.train_mirrored)}

    def imagine(self, one: Arrays, draws: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return states (draws, T, 18) and the first draw's pictures (T, H, W, C) that follow the first observation.

        Args:
            one: One sequence (1, T, ...) as long as those that it learned from; of all but its actions the first
                frame alone is read.
            draws: So many imaginations.
        """
        jax, ninjax = module("jax"), module("ninjax")
        if self._imagine is None:
            self._imagine = jax.jit(ninjax.pure(self._ahead))
        many = {name: np.repeat(values, draws, 0) for name, values in one.items()}
        first = {name: values[:, 0] for name, values in many.items() if name != "action"}
        seed = np.array([self.seed, 7], np.uint32)
        _, (state, image) = self._imagine(dict(self.agent.params), first, many["action"], seed=seed)
        return np.asarray(state, np.float32), np.asarray(image[0], np.float32)

    def _ahead(self, first: Any, action: Any) -> Any:
        """Return states and pictures, by its encoder, dynamics and decoder."""
        jnp, model, (draws, frames) = module("jax.numpy"), self.agent.model, action.shape[:2]
        reset, still = jnp.ones(draws, bool), {"action": jnp.zeros_like(action[:, 0])}
        step = {"training": False, "single": True}
        _, _, tokens = model.enc(model.enc.initial(draws), first, reset, **step)
        carry, _, seen = model.dyn.observe(model.dyn.initial(draws), tokens, still, reset, **step)
        _, ahead, _ = model.dyn.imagine(carry, {"action": action[:, :-1]}, frames - 1, training=False)
        every = {name: jnp.concatenate([seen[name][:, None], ahead[name]], 1) for name in seen}
        found = model.dec(model.dec.initial(draws), every, jnp.zeros((draws, frames), bool), training=False)[2]
        return found["state"].pred(), found["image"].pred()


def _config(folder: Path, size: str, platform: str, seed: int, length: int) -> Any:
    """Return its defaults at one of its sizes; sequences begin with themselves, without context of others."""
    elements, yaml = module("elements"), module("ruamel.yaml").YAML(typ="safe")
    every = yaml.load((folder / "dreamerv3" / "configs.yaml").read_text(encoding="utf-8"))
    config = elements.Config(every["defaults"]).update(every[size])
    config = config.update({"jax.platform": platform, "jax.prealloc": False, "seed": seed, "batch_length": length})
    jax = {**config.jax, "transfer_guard": False, "profiler": False, "precompile": False}
    same = {name: config[name] for name in ("seed", "batch_length", "report_length", "replica", "replicas")}
    return elements.Config(**config.agent, **same, jax=jax, batch_size=BATCH, replay_context=0, logdir=".")


def _spaces(data: Arrays) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what it observes and does, as its spaces."""
    space = module("elements").Space
    observed = {name: space(values.dtype, values.shape[2:]) for name, values in data.items() if name != "action"}
    return observed, {"action": space(np.float32, data["action"].shape[2:], -1, 1)}


def _by_name() -> None:
    """Let `jax.jit` take arguments by place: its code is of JAX 0.4, and JAX 0.11 takes them by name alone."""
    jax = module("jax")
    if not hasattr(jax, "_jit_by_name"):
        jax._jit_by_name = jax.jit
        names = ("in_shardings", "out_shardings", "static_argnums", "static_argnames", "donate_argnums")
        jax.jit = lambda *given, **named: jax._jit_by_name(
            *given[:1], **dict(zip(names, given[1:], strict=False)), **named
        )
