"""Effects that explain as much as each other: rivals, or two that are both needed."""

import numpy as np
import pytest
import torch
from cgwm.pipeline.diagnose.evidence.effect_selection import _without_further
from cgwm.pipeline.physics.parameters import Parameter
from cgwm.pipeline.segments.candidates import variants_of
from cgwm.pipeline.segments.linearization import Linearization
from helpers.diagnosis_data import evidence_of


@pytest.mark.parametrize(
    ("shared", "values", "left"), [(0.0, (2.0, 2.0), 1), (9.5, (2.0, 0.0), 2), (5.0, (3.0, 0.0), 2)]
)
def test_effects_that_show_beside_each_other_are_no_rivals(
    shared: float, values: tuple[float, float], left: int
) -> None:
    """Both act, and each in its own way; one acts, and the other looks like it."""
    equals = [evidence_of("gravity_scale"), evidence_of("spin_damping")]
    candidates = [one.candidate for one in equals]
    variants = variants_of(candidates, torch.zeros(1))
    names = [name for variant in variants for name in variant.parameters]
    parameters = tuple(
        Parameter(name=name, unit="1", bounds=(-9.0, 9.0), logarithmic=False, reveals="", prior=(0.0, 1.0))
        for name in names
    )
    information = np.array([[10.0, shared], [shared, 10.0]])
    linear = Linearization(
        parameters=parameters, base=0, information=information[None], score=(information @ values)[None],
        weight=np.ones(1), episode=np.zeros(1, np.int64), group=np.zeros(1, np.int64), prior=np.zeros(2),
        chi2=np.zeros(1), dof=np.ones(1),
    )  # fmt: skip
    for order in (equals, equals[::-1]):
        kept = _without_further(order, linear, candidates, variants, 1e-4, 1.0)
        assert [one.name for one in kept] == [one.name for one in order[:left]]
