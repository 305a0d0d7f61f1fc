"""Rotations as unit quaternions (w, x, y, z; Hamilton) in torch, batched and differentiable.

Formulas: J. Sola, "Quaternion kinematics for the error-state Kalman filter" (arXiv 1711.02508), sections 1 to 4.
"""

from __future__ import annotations

import torch
from torch import Tensor

_SMALL_ANGLE2 = 1e-8
"""Threshold on the squared angle [rad2] below which the series is exact to double precision."""


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Return the quaternion product a b of quaternions (..., 4): the rotation by b, then by a."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    return torch.cat((aw * bw - (av * bv).sum(-1, keepdim=True), aw * bv + bw * av + cross(av, bv)), -1)


def quat_conjugate(quat_wxyz: Tensor) -> Tensor:
    """Return the inverse of unit quaternions (..., 4)."""
    return torch.cat((quat_wxyz[..., :1], -quat_wxyz[..., 1:]), -1)


def quat_normalize(quat_wxyz: Tensor) -> Tensor:
    """Return quaternions (..., 4) scaled to unit length."""
    return quat_wxyz / quat_wxyz.square().sum(-1, keepdim=True).sqrt()


def quat_to_matrix(quat_wxyz: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    w, x, y, z = quat_wxyz.unbind(-1)
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz, xy, xz, yz = x * x2, y * y2, z * z2, x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    rows = (1 - yy - zz, xy - wz, xz + wy, xy + wz, 1 - xx - zz, yz - wx, xz - wy, yz + wx, 1 - xx - yy)
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def matrix_to_quat(matrix: Tensor) -> Tensor:
    """Return unit quaternions (..., 4), w >= 0, of rotation matrices (..., 3, 3).

    The largest of the four components is taken from the diagonal, which avoids small divisors (Shepperd 1978).
    """
    m = matrix
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    yz, zx, xy = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    sxy, sxz, syz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    candidates = torch.stack(
        (
            torch.stack((1 + xx + yy + zz, yz, zx, xy), -1),
            torch.stack((yz, 1 + xx - yy - zz, sxy, sxz), -1),
            torch.stack((zx, sxy, 1 - xx + yy - zz, syz), -1),
            torch.stack((xy, sxz, syz, 1 - xx - yy + zz), -1),
        ),
        -2,
    )
    best = candidates.diagonal(dim1=-2, dim2=-1).argmax(-1)
    chosen = torch.gather(candidates, -2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    quat = quat_normalize(chosen)
    return torch.where(quat[..., :1] < 0, -quat, quat)


def quat_exp(rotation_vector: Tensor) -> Tensor:
    """Return the unit quaternion (..., 4) of rotation vectors (..., 3) [rad]."""
    angle2 = rotation_vector.square().sum(-1, keepdim=True)
    small = angle2 < _SMALL_ANGLE2
    half = 0.5 * torch.where(small, torch.ones_like(angle2), angle2).sqrt()
    cosine = torch.where(small, 1 - angle2 / 8, half.cos())
    sinc = torch.where(small, 0.5 - angle2 / 48, half.sin() / (2 * half))
    return torch.cat((cosine, sinc * rotation_vector), -1)


def quat_log(quat_wxyz: Tensor) -> Tensor:
    """Return the shortest rotation vectors (..., 3) [rad] of unit quaternions (..., 4)."""
    quat = torch.where(quat_wxyz[..., :1] < 0, -quat_wxyz, quat_wxyz)
    w, vector = quat[..., :1], quat[..., 1:]
    sine2 = vector.square().sum(-1, keepdim=True)
    small = sine2 < _SMALL_ANGLE2
    sine = torch.where(small, torch.ones_like(sine2), sine2).sqrt()
    factor = torch.where(small, 2 / w * (1 - sine2 / (3 * w * w)), 2 * torch.atan2(sine, w) / sine)
    return factor * vector


def quat_turn(from_wxyz: Tensor, to_wxyz: Tensor) -> Tensor:
    """Return the shortest rotation vectors (..., 3) [rad] from orientations (..., 4) to others, axes of the former.

    It is `quat_log` of a product of quaternions, by components that lie together in memory: a third of the time, as
    residuals of many rollouts are mostly these.
    """
    aw, ax, ay, az = from_wxyz.movedim(-1, 0).contiguous()
    bw, bx, by, bz = to_wxyz.movedim(-1, 0).contiguous()
    w = aw * bw + ax * bx + ay * by + az * bz
    x = aw * bx - ax * bw - ay * bz + az * by
    y = aw * by + ax * bz - ay * bw - az * bx
    z = aw * bz - ax * by + ay * bx - az * bw
    vector, cosine = torch.stack((x, y, z)), w.abs()
    sine2 = vector.square().sum(0)
    small = sine2 < _SMALL_ANGLE2
    sine = torch.where(small, torch.ones_like(sine2), sine2).sqrt()
    series = 2 / cosine * (1 - sine2 / (3 * cosine * cosine))
    factor = torch.where(small, series, 2 * torch.atan2(sine, cosine) / sine)
    return (torch.where(w < 0, -factor, factor) * vector).movedim(0, -1)


def continuous_turns(
    times_s: Tensor, quat_wxyz: Tensor, known: Tensor | None = None, reference: Tensor | None = None
) -> Tensor:
    """Return rotation vectors (..., T, 3) [rad] from one orientation of a motion to each, also beyond half a turn.

    The logarithm of a rotation is at most half a turn, so that a fast spin seems to slow down, stop and reverse. Turns
    between neighbouring frames do not: their mean is a spin, and the logarithm is that of the rotation which this spin
    leaves. Its derivative at the reference is the angular velocity in the body frame. Motions whose neighbouring turns
    add up to less than half a turn have the plain logarithm.

    Args:
        times_s: Times of the frames, shape (..., T) [s].
        quat_wxyz: Orientations (body to world), shape (..., T, 4).
        known: 1 where the orientation was measured, 0 elsewhere, shape (..., T); everywhere by default.
        reference: Index of the frame from which the rotations are, where it is known, shape (...); 0 by default.
    """
    known = torch.ones_like(times_s) if known is None else known
    reference = torch.zeros_like(times_s[..., 0], dtype=torch.long) if reference is None else reference
    both = known[..., 1:] * known[..., :-1]
    steps = quat_turn(quat_wxyz[..., :-1, :], quat_wxyz[..., 1:, :]) * both[..., None]
    span = (times_s.diff(dim=-1) * both).sum(-1, keepdim=True).clamp_min(1e-12)
    spin, speed = steps.sum(-2) / span, steps.norm(dim=-1).sum(-1, keepdim=True) / span
    base = quat_wxyz.gather(-2, reference[..., None, None].expand(*reference.shape, 1, 4))
    since = times_s - times_s.gather(-1, reference[..., None])
    turned = quat_multiply(quat_conjugate(base), quat_wxyz)
    plain = quat_log(turned)
    far = (speed * since.abs() * known).amax(-1) > torch.pi
    if not bool(far.any()):
        return plain
    even = spin[..., None, :] * since[..., None]
    left = even + quat_log(quat_multiply(quat_exp(-even), turned))
    return torch.where(far[..., None, None], left, plain)


def quat_rotate(quat_wxyz: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors (..., 3) by unit quaternions (..., 4)."""
    axis = quat_wxyz[..., 1:]
    twice = 2 * cross(axis, vector)
    return vector + quat_wxyz[..., :1] * twice + cross(axis, twice)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Return the cross product of vectors (..., 3), of the more exact type of both; batch dimensions broadcast."""
    if a.dim() != b.dim():
        a, b = torch.broadcast_tensors(a, b)
    if a.dtype != b.dtype:
        exact = torch.promote_types(a.dtype, b.dtype)
        a, b = a.to(exact), b.to(exact)
    return torch.linalg.cross(a, b)


def geodesic_angle(a_wxyz: Tensor, b_wxyz: Tensor) -> Tensor:
    """Return the angle [rad] (...) of the rotation that takes a to b, both unit quaternions (..., 4)."""
    return quat_turn(a_wxyz, b_wxyz).square().sum(-1).sqrt()
