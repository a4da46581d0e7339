"""Rotations. A quaternion is (w, x, y, z) everywhere in this project; the last dimension is the vector.

NumPy arrays go through SciPy's ``Rotation`` (:func:`to_matrices`, :func:`from_matrices`); the other functions take
batches as torch tensors, without copies to or from a device.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from brainbench.core.lazy import lazy_module
from brainbench.core.limits import Limit

if TYPE_CHECKING:
    import torch
    from numpy.typing import ArrayLike, NDArray
else:
    torch = lazy_module("torch")

TURN = 2 * math.pi  # a full turn [rad]: poses with larger angles are taken for degrees and refused

Length = Annotated[float, Limit(above=0, unit="m")]
Coordinate = Annotated[float, Limit(unit="m")]
Angle = Annotated[float, Limit(least=-TURN, most=TURN, unit="rad")]
Vector = tuple[float, float, float]
Point = tuple[Coordinate, Coordinate, Coordinate]
Angles = tuple[Angle, Angle, Angle]


def to_matrices(quaternions: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation matrices [..., 3, 3] of unit quaternions [..., 4]."""
    from scipy.spatial.transform import Rotation

    q = np.asarray(quaternions, dtype=np.float64)
    return Rotation.from_quat(np.roll(q, -1, axis=-1).reshape(-1, 4)).as_matrix().reshape(*q.shape[:-1], 3, 3)


def from_matrices(matrices: ArrayLike) -> NDArray[np.float64]:
    """Return the unit quaternions [..., 4] of rotation matrices [..., 3, 3]."""
    from scipy.spatial.transform import Rotation

    m = np.asarray(matrices, dtype=np.float64)
    return np.roll(Rotation.from_matrix(m.reshape(-1, 3, 3)).as_quat(), 1, axis=-1).reshape(*m.shape[:-2], 4)


def from_rpy(angles: ArrayLike) -> NDArray[np.float64]:
    """Return the unit quaternions [..., 4] of turns about fixed x, y, z by angles [..., 3] (rad), as in URDF."""
    from scipy.spatial.transform import Rotation

    a = np.asarray(angles, dtype=np.float64)
    return np.roll(Rotation.from_euler("xyz", a.reshape(-1, 3)).as_quat(), 1, axis=-1).reshape(*a.shape[:-1], 4)


def euler_matrix(angles: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation matrix [3, 3] of turns about the fixed x, then y, then z axis by ``angles`` [3] (rad)."""
    x, y, z = np.asarray(angles, dtype=np.float64)
    return _about("z", z) @ _about("y", y) @ _about("x", x)


def base_rotation(euler: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation matrices [..., 3, 3] from base frame to world of Euler angles [..., 3] (θ, φ, ζ; rad)."""
    theta, phi, zeta = np.moveaxis(np.asarray(euler, dtype=float), -1, 0)
    return _about("z", theta - np.pi / 2) @ _about("y", -phi) @ _about("x", zeta + np.pi / 2)


def _about(axis: str, angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotation matrices [..., 3, 3] about one coordinate axis."""
    # The cyclic order of the axes gives all three rotations the right-handed sign.
    fixed, first, second = {"x": (0, 1, 2), "y": (1, 2, 0), "z": (2, 0, 1)}[axis]
    matrix, sine = np.zeros((*np.shape(angle), 3, 3)), np.sin(angle)
    matrix[..., fixed, fixed] = 1.0
    matrix[..., first, first] = matrix[..., second, second] = np.cos(angle)
    matrix[..., second, first], matrix[..., first, second] = sine, -sine
    return matrix


def from_z_axis(direction: ArrayLike) -> NDArray[np.float64]:
    """Return the quaternion [4] of the shortest turn of the z axis to a unit vector [3]."""
    x, y, z = np.asarray(direction, dtype=np.float64)
    if z < -1 + 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    q = np.array([1 + z, -y, x, 0.0])
    return q / np.linalg.norm(q)


def constant(values: float | Sequence[float], like: torch.Tensor) -> torch.Tensor:
    """Return numbers [] or [n] as a tensor of the kind of another, on its device; do not write to it.

    It is made once, so that later calls copy nothing to the device.
    """
    key = tuple(values) if isinstance(values, Sequence) else values
    return _constant(key, like.device, like.dtype)


@cache
def _constant(values: Any, device: torch.device, dtype: torch.dtype) -> torch.Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, device=device, dtype=dtype)


def multiply(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the quaternions [..., 4] of turning by b first, then by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def conjugate(q: torch.Tensor) -> torch.Tensor:
    """Return the inverse turns [..., 4] of unit quaternions."""
    return torch.cat((q[..., :1], -q[..., 1:]), dim=-1)


def from_xyzw(q: torch.Tensor) -> torch.Tensor:
    """Return quaternions (x, y, z, w) [..., 4] as (w, x, y, z)."""
    return torch.cat((q[..., 3:], q[..., :3]), dim=-1)


def rotate(q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Return vectors [..., 3] turned by unit quaternions [..., 4]."""
    u, w = q[..., 1:], q[..., :1]
    v = v.expand(u.shape)
    t = 2 * torch.linalg.cross(u, v)
    return v + w * t + torch.linalg.cross(u, t)


def about(axis: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Return the quaternions [..., 4] of turns by angles [...] (rad) about unit axes [..., 3]."""
    half = 0.5 * angle.unsqueeze(-1)
    return torch.cat((torch.cos(half), torch.sin(half) * axis), dim=-1)


def angle_of(q: torch.Tensor) -> torch.Tensor:
    """Return the angle [...] (rad, 0 to pi) by which unit quaternions turn."""
    return 2 * torch.atan2(q[..., 1:].norm(dim=-1), q[..., 0].abs())


def twist_and_swing(q: torch.Tensor, axis: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Split turns into the signed angle [...] about an axis [..., 3] and the angle [...] of the rest (rad).

    A turn is its twist about the axis followed by a swing about an axis perpendicular to it.
    """
    along = (q[..., 1:] * axis).sum(dim=-1)
    twist = 2 * torch.atan2(along, q[..., 0])
    twist = torch.remainder(twist + torch.pi, 2 * torch.pi) - torch.pi
    swing = 2 * torch.acos(torch.sqrt(q[..., 0] ** 2 + along**2).clamp(max=1.0))
    return twist, swing


def twist_of(q: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
    """Return the part [..., 4] of turns that lies about a unit axis [..., 3]; no turn where the axis is zero.

    Without it a turn is the smallest that differs from the whole by a turn about that axis.
    """
    along = (q[..., 1:] * axis).sum(dim=-1, keepdim=True)
    twist = torch.cat((q[..., :1], along * axis), dim=-1)
    length = twist.norm(dim=-1, keepdim=True)
    none = constant((1.0, 0.0, 0.0, 0.0), q).expand_as(twist)
    # A half turn across the axis has no twist of its own.
    return torch.where((length > 1e-6) & axis.any(dim=-1, keepdim=True), twist / length.clamp(min=1e-6), none)


def six_numbers(q: torch.Tensor) -> torch.Tensor:
    """Return the first two columns of the rotation matrices as [..., 6] (Zhou et al. 2019)."""
    x, y = constant((1.0, 0.0, 0.0), q), constant((0.0, 1.0, 0.0), q)
    return torch.cat((rotate(q, x), rotate(q, y)), dim=-1)


def tilted(turn_x: torch.Tensor, turn_y: torch.Tensor) -> torch.Tensor:
    """Return the quaternions [..., 4] of a turn about x by angles [...], then about the fixed y (rad)."""
    x, y = constant((1.0, 0.0, 0.0), turn_x), constant((0.0, 1.0, 0.0), turn_x)
    return multiply(about(y, turn_y), about(x, turn_x))
