"""Laws of the rotation group."""

import math

import pytest
import torch
from cgwm.pipeline.geometry.rotation import (
    cross,
    geodesic_angle,
    matrix_to_quat,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    quat_to_matrix,
)

TIGHT = 1e-12  # double precision, a few operations


@pytest.fixture
def quats() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return quat_normalize(torch.randn(3, 50, 4, generator=generator, dtype=torch.float64))


def test_group_axioms(quats: torch.Tensor) -> None:
    a, b, c = quats
    left, right = quat_multiply(quat_multiply(a, b), c), quat_multiply(a, quat_multiply(b, c))
    torch.testing.assert_close(left, right, atol=TIGHT, rtol=0)
    one = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(50, 4)
    torch.testing.assert_close(quat_multiply(a, quat_conjugate(a)), one, atol=TIGHT, rtol=0)
    torch.testing.assert_close(quat_multiply(a, one), a, atol=0, rtol=0)


def test_matrices_multiply_as_quaternions_do(quats: torch.Tensor) -> None:
    a, b, _ = quats
    product = quat_to_matrix(a) @ quat_to_matrix(b)
    torch.testing.assert_close(quat_to_matrix(quat_multiply(a, b)), product, atol=TIGHT, rtol=0)
    torch.testing.assert_close(product.det(), torch.ones(50, dtype=torch.float64), atol=TIGHT, rtol=0)


def test_a_quaternion_and_its_negative_are_one_rotation(quats: torch.Tensor) -> None:
    a, b, _ = quats
    vector = torch.randn(50, 3, dtype=torch.float64)
    torch.testing.assert_close(quat_rotate(a, vector), quat_rotate(-a, vector), atol=TIGHT, rtol=0)
    torch.testing.assert_close(quat_log(a), quat_log(-a), atol=TIGHT, rtol=0)
    torch.testing.assert_close(geodesic_angle(a, b), geodesic_angle(-a, b), atol=TIGHT, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1e-3, 1.0, 3.0, math.pi - 1e-6])
def test_exponential_and_logarithm_are_inverse(angle: float) -> None:
    axis = torch.tensor([[0.6, -0.48, 0.64]], dtype=torch.float64)
    torch.testing.assert_close(quat_log(quat_exp(angle * axis)), angle * axis, atol=1e-9, rtol=0)


def test_matrix_round_trip_also_at_half_turns(quats: torch.Tensor) -> None:
    half_turns = torch.eye(4, dtype=torch.float64)[1:]
    both = torch.cat((quats[0], half_turns))
    back = matrix_to_quat(quat_to_matrix(both))
    torch.testing.assert_close(quat_to_matrix(back), quat_to_matrix(both), atol=TIGHT, rtol=0)


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1.0, 3.0])
def test_derivatives_are_finite_and_right_also_at_zero(scale: float) -> None:
    vector = scale * torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda v: quat_log(quat_exp(v)), vector.requires_grad_(), eps=1e-7, atol=1e-5)


def test_cross_products_broadcast_and_take_the_more_exact_type() -> None:
    a, b = torch.randn(4, 1, 3, dtype=torch.float64), torch.randn(5, 3, dtype=torch.float64)
    found = cross(a, b)
    assert found.shape == (4, 5, 3)
    for i in range(4):
        for j in range(5):
            torch.testing.assert_close(found[i, j], torch.linalg.cross(a[i, 0], b[j]))
    assert cross(a, b.float()).dtype == cross(a.float(), b).dtype == torch.float64
