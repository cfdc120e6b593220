"""The loop that sums up how far a depth map lies off the surface of another."""

from __future__ import annotations

import math

import numpy as np

from sidelong.kernels import compiled, inlined
from sidelong.types import Float32Array, FloatArray

REACH_PX = 3
"""Slopes are taken from depths this far to both sides: nearer, their noise would turn normals by ten degrees."""

INDEPENDENT_PX = 6
"""Every so many-th row and column takes part: within its window the errors of a stereo matcher are much alike."""
FLAT_M, FLAT_SIGMAS = 1e-3, 2.0
"""How far the middle of three depths may be off the mean of the outer two, twice; and as much for noise."""
LEAST_VARIANCE_M2 = 1e-14
"""A tenth of a micrometre: depth without noise is no reason to divide by zero."""
FLATTENED = 0.3
"""Of such a bend, what the mean over the window takes off."""
LEAST_AGREEMENT = 0.8
"""Cosine between the normals of both views: what faces elsewhere is another surface."""


@compiled
def accumulate(
    view: tuple[Float32Array, Float32Array],
    reference: tuple[Float32Array, Float32Array],
    reference_T_view: FloatArray,
    camera: FloatArray,
    alike: tuple[float, float],
    kernel_m: float,
    as_seen: bool,
    first: int,
    last: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, int]:
    """Return normal equations of point-to-plane registration, and how many points take part.

    Residuals are distances from planes of the reference. The noise of their normals, squared, would look like
    information: a plane whose normals waver seems to hold against sliding. So residuals are projected on the normals of
    the view, whose errors are independent of them (instrumental variables), and the matrix is not symmetric.

    Parameters
    ----------
    view, reference
        (H, W) depth and its standard deviation, NaN where missing.
    reference_T_view
        (4, 4).
    camera
        fx, fy, cx, cy.
    alike
        Standard deviation of the error that all depths of the view, and of the reference, have in common, over their
        squared depth (1/m): an offset of disparity, and as much of a tilt across the image's width and height.
    kernel_m
        Residuals beyond it have no weight (Tukey); at least four standard deviations have some.
    as_seen
        Whether a point that is farther off than its noise says scatters as it is off (White, 1980).
    first, last
        Of every ``INDEPENDENT_PX``-th row of the view, those that take part.

    Returns
    -------
    hessian, gradient, scatter
        (6, 6), (6,) and (6, 6): information on a small turn about the view's camera and a small shift, in the
        reference's axes, the gradient, and the covariance that noise gives it.
    modes
        (6, 6) what each of the errors that depths have in common adds to the gradient, one a column.
    count
        Points with weight.
    """
    depth_m, sigma_m = view
    surface_m, surface_sigma_m = reference
    fx, fy, cx, cy = camera
    height, width = surface_m.shape
    hessian, gradient, scatter = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6))
    jacobian, instrument, off_m, modes = np.empty(6), np.empty(6), np.empty(6), np.zeros((6, 6))
    count = 0
    for index in range(first, last):
        row = INDEPENDENT_PX * index + INDEPENDENT_PX // 2
        for column in range(INDEPENDENT_PX // 2, depth_m.shape[1], INDEPENDENT_PX):
            z = depth_m[row, column]
            if not z > 0:
                continue
            arm_x = z * (column - cx) / fx
            arm_y = z * (row - cy) / fy
            x, y, w = _rotated(reference_T_view, arm_x, arm_y, z)
            arm = (x, y, w)
            x, y, w = x + reference_T_view[0, 3], y + reference_T_view[1, 3], w + reference_T_view[2, 3]
            if not w > 0:
                continue
            u, v = int(fx * x / w + cx + 0.5), int(fy * y / w + cy + 0.5)
            if not (REACH_PX <= u < width - REACH_PX and REACH_PX <= v < height - REACH_PX):
                continue
            n_x, n_y, n_z, length, bend_m = _plane(surface_m, surface_sigma_m, u, v, camera)
            own_x, own_y, own_z, own_length, own_bend_m = _plane(depth_m, sigma_m, column, row, camera)
            if not length * own_length > 0:
                continue
            residual = n_x * x + n_y * y + n_z * w - 1.0 / length
            own_x, own_y, own_z = _rotated(reference_T_view, own_x, own_y, own_z)
            if own_x * n_x + own_y * n_y + own_z * n_z < LEAST_AGREEMENT:
                continue
            # both depths err along their lines of sight
            own_facing = (n_x * arm[0] + n_y * arm[1] + n_z * arm[2]) / z
            its_facing = 1.0 / (surface_m[v, u] * length)
            own, its = sigma_m[row, column] * own_facing, surface_sigma_m[v, u] * its_facing
            variance = (
                LEAST_VARIANCE_M2 + own * own + its * its + (FLATTENED * bend_m) ** 2 + (FLATTENED * own_bend_m) ** 2
            )
            reach = max(kernel_m, 4.0 * math.sqrt(variance))
            share = residual * residual / (reach * reach)
            if share >= 1.0:
                continue
            weight = (1.0 - share) ** 2 / variance
            spread = weight * max(1.0, residual * residual / variance) if as_seen else weight
            _fill_jacobian(jacobian, arm, n_x, n_y, n_z)
            _fill_jacobian(instrument, arm, own_x, own_y, own_z)
            own_off, its_off = alike[0] * z * z * own_facing, alike[1] * surface_m[v, u] ** 2 * its_facing
            _fill_modes(off_m, 0, own_off, 2.0 * column / width - 1.0, 2.0 * row / height - 1.0)
            _fill_modes(off_m, 3, its_off, 2.0 * u / width - 1.0, 2.0 * v / height - 1.0)
            for i in range(6):
                gradient[i] += weight * residual * instrument[i]
                for j in range(6):
                    scatter[i, j] += spread * instrument[i] * instrument[j]
                    modes[i, j] += weight * instrument[i] * off_m[j]
                    hessian[i, j] += weight * instrument[i] * jacobian[j]
            count += 1
    return hessian, gradient, scatter, modes, count


@inlined
def _fill_modes(off_m: FloatArray, first: int, size_m: float, across: float, down: float) -> None:
    """Fill in what an offset of disparity, and a tilt of it across the image and down, do to a residual."""
    off_m[first], off_m[first + 1], off_m[first + 2] = size_m, size_m * across, size_m * down


@inlined
def _fill_jacobian(jacobian: FloatArray, arm: tuple[float, float, float], n_x: float, n_y: float, n_z: float) -> None:
    """Fill in how a distance along a normal changes with a small turn of the arm to a point, and a small shift."""
    jacobian[0] = arm[1] * n_z - arm[2] * n_y
    jacobian[1] = arm[2] * n_x - arm[0] * n_z
    jacobian[2] = arm[0] * n_y - arm[1] * n_x
    jacobian[3], jacobian[4], jacobian[5] = n_x, n_y, n_z


@inlined
def _plane(
    depth_m: Float32Array, sigma_m: Float32Array, u: int, v: int, camera: FloatArray
) -> tuple[float, float, float, float, float]:
    """Return the normal of the plane around a pixel, one over its distance from the camera, and how far it bends.

    All are 0 where it bends too far, or a depth is missing.
    """
    height, width = depth_m.shape
    fx, fy, cx, cy = camera
    if not (REACH_PX <= u < width - REACH_PX and REACH_PX <= v < height - REACH_PX):
        return 0.0, 0.0, 0.0, 0.0, 0.0
    q = 1.0 / depth_m[v, u]
    left, right = 1.0 / depth_m[v, u - REACH_PX], 1.0 / depth_m[v, u + REACH_PX]
    above, below = 1.0 / depth_m[v - REACH_PX, u], 1.0 / depth_m[v + REACH_PX, u]
    # inverse depth is affine on a plane, bends little on what is curved, and much across an edge
    across, down = abs(left + right - 2.0 * q), abs(above + below - 2.0 * q)
    limit = (FLAT_M + FLAT_SIGMAS * sigma_m[v, u]) * q * q
    if not (across <= limit and down <= limit):
        return 0.0, 0.0, 0.0, 0.0, 0.0
    q_u, q_v = (right - left) / (2 * REACH_PX), (below - above) / (2 * REACH_PX)
    n_x, n_y, n_z = q_u * fx, q_v * fy, q - q_u * (u - cx) - q_v * (v - cy)
    length = math.sqrt(n_x * n_x + n_y * n_y + n_z * n_z)
    return n_x / length, n_y / length, n_z / length, length, max(across, down) / (q * q)


@inlined
def _rotated(pose: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z,
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z,
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z,
    )
