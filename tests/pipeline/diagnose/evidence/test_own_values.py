"""Numbers of effects beside one that has values of its own in each episode or session."""

from dataclasses import replace

import numpy as np
import pytest
from cgwm.pipeline.diagnose.evidence.falsification import _beside_own
from cgwm.pipeline.physics.parameters import FRICTION
from cgwm.pipeline.segments.linearization import Linearization, sums


def test_numbers_beside_an_effect_with_values_of_their_own_are_those_of_a_joint_fit() -> None:
    """Flights of four episodes of two sessions with one common number and one of each owner."""
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(8, 6, 2))
    episode, group = np.arange(8) // 2, np.arange(8) // 4
    for by_episode, owner in ((True, episode), (False, group)):
        own = rng.normal(size=owner.max() + 1)
        seen = np.einsum("bnp,bp->bn", rows, np.stack([np.full(8, 0.7), own[owner]], 1))
        linear = Linearization(
            parameters=(FRICTION, replace(FRICTION, name="own")),
            base=1,
            information=np.einsum("bnp,bnq->bpq", rows, rows),
            score=np.einsum("bnp,bn->bp", rows, seen),
            weight=np.ones(8),
            episode=episode,
            group=group,
            prior=np.zeros(2),
            chi2=np.ones(8),
            dof=np.ones(8),
        )
        cleaned = _beside_own(linear, [0], [1], by_episode, 1.0)
        information, score = sums(cleaned, [0])
        assert score[0] / information[0, 0] == pytest.approx(0.7)
        columns = np.zeros((8, 6, 1 + len(own)))
        columns[..., 0] = rows[..., 0]
        columns[np.arange(8), :, 1 + owner] = rows[..., 1]
        joint = np.einsum("bnp,bnq->pq", columns, columns)
        assert information[0, 0] == pytest.approx(1 / np.linalg.inv(joint)[0, 0])
