"""Forward derivatives where torch keeps no record of derivatives."""

import pytest
import torch
from cgwm.pipeline.optimization.forward_mode import batched_jacobian


def test_derivatives_in_inference_mode() -> None:
    inputs = torch.tensor([[0.5, -2.0]], dtype=torch.float64)
    with torch.inference_mode():
        scale = torch.full((1,), 3.0, dtype=torch.float64)
        value, jacobian = batched_jacobian(lambda x, _: scale * x.square().prod(1, keepdim=True), inputs.clone())
    assert float(value) == pytest.approx(3.0)
    assert jacobian[0, 0].tolist() == pytest.approx([12.0, -3.0])
