"""Two-view models over corner tracks: a turn (3 parameters), a turn and a direction (5), each by robust least squares.

A pair's rotation R and translation t take coordinates in the first camera to the second: ``x2 = R x1 + t``.
Corners are given as normalised coordinates ``(u, v) = ((x - cx) / fx, (y - cy) / fy)``, noise in the same unit.
"""

import math

import numpy as np
from numba import njit


@njit(cache=True)
def rotation_from_vector(vector: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of a (3,) rotation vector (Rodrigues)."""
    x, y, z = vector[0], vector[1], vector[2]
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-9:
        a, b = 1.0, 0.5
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    out = np.empty((3, 3))
    out[0, 0], out[1, 1], out[2, 2] = 1 - b * (y * y + z * z), 1 - b * (x * x + z * z), 1 - b * (x * x + y * y)
    out[0, 1], out[1, 0] = b * x * y - a * z, b * x * y + a * z
    out[0, 2], out[2, 0] = b * x * z + a * y, b * x * z - a * y
    out[1, 2], out[2, 1] = b * y * z - a * x, b * y * z + a * x
    return out


@njit(cache=True)
def tangent_basis(direction: np.ndarray) -> np.ndarray:
    """(2, 3): two unit vectors orthogonal to a unit direction and to each other."""
    least = 0
    for axis in range(1, 3):
        if abs(direction[axis]) < abs(direction[least]):
            least = axis
    helper = np.zeros(3)
    helper[least] = 1.0
    first = np.cross(direction, helper)
    first /= math.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2)
    out = np.empty((2, 3))
    out[0] = first
    out[1] = np.cross(direction, first)
    return out


@njit(cache=True)
def turning_residuals(first: np.ndarray, second: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(n, 2): where the second corner lies from where a pure rotation takes the first."""
    out = np.empty((len(first), 2))
    for i in range(len(first)):
        u, v = first[i, 0], first[i, 1]
        z = rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2]
        out[i, 0] = second[i, 0] - (rotation[0, 0] * u + rotation[0, 1] * v + rotation[0, 2]) / z
        out[i, 1] = second[i, 1] - (rotation[1, 0] * u + rotation[1, 1] * v + rotation[1, 2]) / z
    return out


@njit(cache=True)
def fit_turning(
    first: np.ndarray, second: np.ndarray, weight: np.ndarray, rotation: np.ndarray, scales: np.ndarray
) -> np.ndarray:
    """Rotation by Geman-McClure IRLS, one Gauss-Newton step for each of the given (narrowing) robust scales."""
    rotation = rotation.copy()
    for scale in scales:
        normal = np.zeros((3, 3))
        right = np.zeros(3)
        residuals = turning_residuals(first, second, rotation)
        for i in range(len(first)):
            u, v = second[i, 0] - residuals[i, 0], second[i, 1] - residuals[i, 1]
            square = residuals[i, 0] ** 2 + residuals[i, 1] ** 2
            w = weight[i] / (1.0 + square / (scale * scale)) ** 2
            # Of a turn omega, a direction (u, v, 1) moves by omega x (u, v, 1), seen on the plane z = 1.
            ju = np.array([-u * v, 1.0 + u * u, -v])
            jv = np.array([-1.0 - v * v, u * v, u])
            for a in range(3):
                right[a] += w * (ju[a] * residuals[i, 0] + jv[a] * residuals[i, 1])
                for b in range(3):
                    normal[a, b] += w * (ju[a] * ju[b] + jv[a] * jv[b])
        for a in range(3):
            normal[a, a] += 1e-9
        rotation = rotation_from_vector(np.linalg.solve(normal, right)) @ rotation
    return rotation


@njit(cache=True, inline="always")
def _epipolar_lines(u, v, p, q, rotation, t):  # pragma: no cover - compiled
    """What the Sampson distance of the match (u, v), (p, q) is made of, for the essential matrix E = [t]x R.

    Returns:
        a = R (u, v, 1); the line t x a = E (u, v, 1) in the second picture; m = (p, q, 1) x t, and the first two of
        R^T m = E^T (p, q, 1), the line in the first picture: 11 numbers.
    """
    a0 = rotation[0, 0] * u + rotation[0, 1] * v + rotation[0, 2]
    a1 = rotation[1, 0] * u + rotation[1, 1] * v + rotation[1, 2]
    a2 = rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2]
    line0, line1, line2 = t[1] * a2 - t[2] * a1, t[2] * a0 - t[0] * a2, t[0] * a1 - t[1] * a0
    m0, m1, m2 = q * t[2] - t[1], t[0] - p * t[2], p * t[1] - q * t[0]
    back0 = rotation[0, 0] * m0 + rotation[1, 0] * m1 + rotation[2, 0] * m2
    back1 = rotation[0, 1] * m0 + rotation[1, 1] * m1 + rotation[2, 1] * m2
    return a0, a1, a2, line0, line1, line2, m0, m1, m2, back0, back1


@njit(cache=True)
def sampson_residuals(first: np.ndarray, second: np.ndarray, rotation: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(n,) signed Sampson distances to the epipolar constraint (Hartley and Zisserman, eq. 11.9)."""
    out = np.empty(len(first))
    for i in range(len(first)):
        u, v, p, q = first[i, 0], first[i, 1], second[i, 0], second[i, 1]
        _, _, _, l0, l1, l2, _, _, _, k0, k1 = _epipolar_lines(u, v, p, q, rotation, direction)
        out[i] = (p * l0 + q * l1 + l2) / math.sqrt(l0 * l0 + l1 * l1 + k0 * k0 + k1 * k1 + 1e-24)
    return out


@njit(cache=True)
def _sampson_system(
    first: np.ndarray,
    second: np.ndarray,
    weight: np.ndarray,
    rotation: np.ndarray,
    direction: np.ndarray,
    basis: np.ndarray,
    scale: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton normal matrix (5, 5) and right side (5,) of the weighted Sampson distances, derivatives in full."""
    normal = np.zeros((5, 5))
    right = np.zeros(5)
    row = np.empty(5)
    t = direction
    for i in range(len(first)):
        u, v, p, q = first[i, 0], first[i, 1], second[i, 0], second[i, 1]
        a0, a1, a2, line0, line1, line2, m0, m1, m2, back0, back1 = _epipolar_lines(u, v, p, q, rotation, t)
        a = (a0, a1, a2)
        square = line0 * line0 + line1 * line1 + back0 * back0 + back1 * back1 + 1e-24
        length = math.sqrt(square)
        value = p * line0 + q * line1 + line2
        residual = value / length
        ta = t[0] * a[0] + t[1] * a[1] + t[2] * a[2]
        ab = a[0] * p + a[1] * q + a[2]
        b = (p, q, 1.0)
        for k in range(3):
            # d(t x (omega x a)) / d omega_k = e_k (t.a) - a t_k ; d(R^T (m - omega x m)) = R^T (m x e_k)
            d_line0 = (ta if k == 0 else 0.0) - a[0] * t[k]
            d_line1 = (ta if k == 1 else 0.0) - a[1] * t[k]
            if k == 0:
                n0, n1, n2 = 0.0, m2, -m1
            elif k == 1:
                n0, n1, n2 = -m2, 0.0, m0
            else:
                n0, n1, n2 = m1, -m0, 0.0
            d_back0 = rotation[0, 0] * n0 + rotation[1, 0] * n1 + rotation[2, 0] * n2
            d_back1 = rotation[0, 1] * n0 + rotation[1, 1] * n1 + rotation[2, 1] * n2
            d_square = line0 * d_line0 + line1 * d_line1 + back0 * d_back0 + back1 * d_back1
            row[k] = (ta * b[k] - ab * t[k]) / length - residual * d_square / square
        for k in range(2):
            s0, s1, s2 = basis[k, 0], basis[k, 1], basis[k, 2]
            d_line0, d_line1, d_line2 = s1 * a[2] - s2 * a[1], s2 * a[0] - s0 * a[2], s0 * a[1] - s1 * a[0]
            n0, n1, n2 = q * s2 - s1, s0 - p * s2, p * s1 - q * s0
            d_back0 = rotation[0, 0] * n0 + rotation[1, 0] * n1 + rotation[2, 0] * n2
            d_back1 = rotation[0, 1] * n0 + rotation[1, 1] * n1 + rotation[2, 1] * n2
            d_square = line0 * d_line0 + line1 * d_line1 + back0 * d_back0 + back1 * d_back1
            row[3 + k] = (p * d_line0 + q * d_line1 + d_line2) / length - residual * d_square / square
        w = weight[i] / (1.0 + residual * residual / (scale * scale)) ** 2
        for k in range(5):
            right[k] -= w * row[k] * residual
            for j in range(5):
                normal[k, j] += w * row[k] * row[j]
    return normal, right


@njit(cache=True)
def fit_moving(
    first: np.ndarray,
    second: np.ndarray,
    weight: np.ndarray,
    rotation: np.ndarray,
    direction: np.ndarray,
    scales: np.ndarray,
    noise: float,
    prior_direction: np.ndarray,
    prior_sigma: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation and direction by Geman-McClure IRLS on Sampson distances.

    One damped Gauss-Newton step for each of the given (narrowing) robust scales. ``prior_sigma`` (radians; 0 for none)
    draws the direction's axis, not its sign, towards ``prior_direction``. Returns rotation, direction and the (5, 5)
    information.
    """
    rotation, direction = rotation.copy(), direction.copy()
    information = np.zeros((5, 5))
    for scale in scales:
        basis = tangent_basis(direction)
        normal, right = _sampson_system(first, second, weight, rotation, direction, basis, scale)
        normal /= noise * noise
        right /= noise * noise
        if prior_sigma > 0.0:
            sign = 1.0 if np.dot(prior_direction, direction) >= 0.0 else -1.0
            for k in range(2):
                normal[3 + k, 3 + k] += 1.0 / prior_sigma**2
                right[3 + k] += sign * np.dot(prior_direction, basis[k]) / prior_sigma**2
        information = normal.copy()
        for k in range(5):
            normal[k, k] = normal[k, k] * (1.0 + 1e-6) + 1.0
        step = np.linalg.solve(normal, right)
        length = math.sqrt(step[3] ** 2 + step[4] ** 2)
        if length > 0.3:
            step *= 0.3 / length
        rotation = rotation_from_vector(step[:3]) @ rotation
        direction = direction + step[3] * basis[0] + step[4] * basis[1]
        direction /= math.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    return rotation, direction, information


@njit(cache=True)
def parallaxes(first: np.ndarray, second: np.ndarray, rotation: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(n, 2): signed motion along the epipolar line, once the turn is taken out, and its size for unit inverse depth.

    Their quotient is the inverse depth (in the second camera's frame before it moved) in units of the translation; a
    negative one lies behind the camera, or the direction's sign is wrong.
    """
    out = np.empty((len(first), 2))
    for i in range(len(first)):
        u, v = first[i, 0], first[i, 1]
        z = rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2]
        x = (rotation[0, 0] * u + rotation[0, 1] * v + rotation[0, 2]) / z
        y = (rotation[1, 0] * u + rotation[1, 1] * v + rotation[1, 2]) / z
        # A point at depth d in front of the turned first camera, (x, y, 1) d, moves to (x d + t0, y d + t1) / (d + t2):
        # second - (x, y) = (t01 - t2 second) / d.
        gain0, gain1 = direction[0] - direction[2] * second[i, 0], direction[1] - direction[2] * second[i, 1]
        gain = math.sqrt(gain0 * gain0 + gain1 * gain1) + 1e-12
        out[i, 0] = ((second[i, 0] - x) * gain0 + (second[i, 1] - y) * gain1) / gain
        out[i, 1] = gain
    return out
