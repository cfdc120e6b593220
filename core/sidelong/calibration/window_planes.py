"""Planes through the windows of a depth map: the fits behind :mod:`sidelong.calibration.normals`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.types import BoolArray, FloatArray

Method: TypeAlias = Literal["inverse_depth", "pca"]
PLANE_PARAMETERS = 3
STRIP_ROWS = 32
"""Rows worked on at once, so that what lies between input and result stays in the processor's cache."""
THINNEST = 1e-3
"""Least ratio of the variances of a window's points, in the image, across and along: a line has no plane."""


@dataclass(frozen=True, eq=False)
class Planes:
    """The plane of each window, (H, W); NaN where none can be fitted, but for ``count``.

    Attributes
    ----------
    normals
        (H, W, 3) unit normals, turned to the camera.
    rms
        Of the residuals in 1/z, per degree of freedom, 1/m.
    distance, turn
        What an error of 1 in 1/z is as a distance from the plane (m), and as an rms angle of the normal (rad).
    count
        Usable points in the window.
    """

    normals: FloatArray
    rms: FloatArray
    distance: FloatArray
    turn: FloatArray
    count: FloatArray


@dataclass(frozen=True, eq=False)
class _Strip:
    """Some rows of a map with the margin their windows need; ``inner`` are those rows.

    1/z is 0 where not usable; ``x`` and ``y`` are image coordinates at z = 1; ``kernels`` are ones, and the distances
    from the centre of a window along x and y.
    """

    inverse: FloatArray
    usable: BoolArray
    x: FloatArray
    y: FloatArray
    inner: slice
    kernels: tuple[FloatArray, FloatArray, FloatArray]

    def sums(self, image: FloatArray, along_u: FloatArray, along_v: FloatArray) -> FloatArray:
        """Correlate with a kernel, nothing beyond the border. Each pixel is summed anew: running sums lose digits."""
        import cv2

        summed = cv2.sepFilter2D(image, cv2.CV_64F, along_u, along_v, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed, dtype=np.float64)[self.inner]


@dataclass(frozen=True, eq=False)
class _Spread:
    """Where the points of each window lie, from its centre at z = 1: their number, mean and covariance.

    ``share`` is 1 over the number, NaN where no plane can be fitted.
    """

    count: FloatArray
    share: FloatArray
    u: FloatArray
    v: FloatArray
    uu: FloatArray
    vv: FloatArray
    uv: FloatArray
    det: FloatArray


def fit_planes(
    inverse: FloatArray, usable: BoolArray, camera: PinholeCamera, method: Method, radius_px: int, fewest_points: int
) -> Planes:
    """Fit a plane to the usable points around each usable pixel.

    Parameters
    ----------
    inverse
        (H, W) 1/z in 1/m; read where usable.
    usable
        (H, W) pixels whose depth counts.
    camera
        Its intrinsics.
    method
        Least squares in 1/z, or principal components in space.
    radius_px
        Of the square window: 2 r + 1 pixels wide.
    fewest_points
        A window with fewer has no plane.
    """
    fitted = _inverse_depth if method == "inverse_depth" else _principal
    height, width = inverse.shape
    rms, distance, turn = np.full((3, height, width), np.nan)
    whole = Planes(np.full((height, width, 3), np.nan), rms, distance, turn, np.zeros((height, width)))
    with np.errstate(invalid="ignore", divide="ignore"):
        for rows, strip in _strips(inverse, usable, camera, radius_px):
            spread = _spread(strip, fewest_points)
            normals, whole.rms[rows], whole.distance[rows], whole.turn[rows] = fitted(strip, spread)
            for axis, component in enumerate(normals):
                whole.normals[rows, :, axis] = component
            whole.count[rows] = spread.count
    return whole


def _strips(
    inverse: FloatArray, usable: BoolArray, camera: PinholeCamera, radius_px: int
) -> Iterator[tuple[slice, _Strip]]:
    """Yield the strips that hold anything usable, and the rows they stand for."""
    x: FloatArray = (np.arange(camera.width, dtype=np.float64)[None, :] - camera.cx) / camera.fx
    y: FloatArray = (np.arange(camera.height, dtype=np.float64)[:, None] - camera.cy) / camera.fy
    offset = np.arange(-radius_px, radius_px + 1, dtype=np.float64)
    kernels = np.ones_like(offset), offset / camera.fx, offset / camera.fy
    for top in range(0, camera.height, STRIP_ROWS):
        bottom = min(top + STRIP_ROWS, camera.height)
        wide = slice(max(top - radius_px, 0), min(bottom + radius_px, camera.height))
        if not usable[wide].any():
            continue
        values = np.where(usable[wide], inverse[wide], 0.0)
        inner = slice(top - wide.start, bottom - wide.start)
        yield slice(top, bottom), _Strip(values, usable[wide], x, y[wide], inner, kernels)


def _spread(strip: _Strip, fewest_points: int) -> _Spread:
    one, along_u, along_v = strip.kernels
    mask = strip.usable.astype(np.float64)
    count = np.rint(strip.sums(mask, one, one))
    share = np.where(strip.usable[strip.inner] & (count >= fewest_points), 1.0 / count, np.nan)
    u, v = strip.sums(mask, along_u, one) * share, strip.sums(mask, one, along_v) * share
    uu = strip.sums(mask, along_u**2, one) * share - u * u
    vv = strip.sums(mask, one, along_v**2) * share - v * v
    uv = strip.sums(mask, along_u, along_v) * share - u * v
    det = uu * vv - uv * uv
    share[~(det > THINNEST * (uu + vv) ** 2)] = np.nan
    return _Spread(count, share, u, v, uu, vv, uv, det)


_Found: TypeAlias = tuple[tuple[FloatArray, FloatArray, FloatArray], FloatArray, FloatArray, FloatArray]
"""Of a strip: the components of the normal, then ``rms``, ``distance`` and ``turn`` of :class:`Planes`."""


def _inverse_depth(strip: _Strip, at: _Spread) -> _Found:
    """Fit 1/z = g . (x, y, 1), counted from each window's centre so that no digits are lost."""
    one, along_u, along_v = strip.kernels
    w = strip.sums(strip.inverse, one, one) * at.share
    uw = strip.sums(strip.inverse, along_u, one) * at.share - at.u * w
    vw = strip.sums(strip.inverse, one, along_v) * at.share - at.v * w
    ww = strip.sums(strip.inverse**2, one, one) * at.share - w * w
    gx, gy = (at.vv * uw - at.uv * vw) / at.det, (at.uu * vw - at.uv * uw) / at.det
    rms = np.sqrt(np.maximum(ww - gx * uw - gy * vw, 0.0) * at.count / (at.count - PLANE_PARAMETERS))
    at_centre = w - gx * at.u - gy * at.v
    x, y = strip.x, strip.y[strip.inner]
    gz = at_centre - gx * x - gy * y
    # g points away from the camera
    scale = -1.0 / np.sqrt(gx * gx + gy * gy + gz * gz)
    nx, ny, nz = gx * scale, gy * scale, gz * scale
    # g turns with the slopes along (1, 0, -x) and (0, 1, -y); of these, what lies along g does not turn it. The mean
    # of 1/z adds next to nothing: 1/f^2 of this
    along_x, along_y = nx - nz * x, ny - nz * y
    turn = at.vv * (1 + x * x - along_x**2) + at.uu * (1 + y * y - along_y**2) - 2 * at.uv * (x * y - along_x * along_y)
    return (nx, ny, nz), rms, -scale / at_centre, -scale * np.sqrt(turn * at.share / at.det)


def _principal(strip: _Strip, at: _Spread) -> _Found:
    """Take the direction in which each window's points in space vary least."""
    points = np.stack(np.broadcast_arrays(strip.x / strip.inverse, strip.y / strip.inverse, 1.0 / strip.inverse))
    fitted = np.isfinite(at.share)
    there = points[:, strip.inner][:, fitted]
    variances, axes = np.linalg.eigh(_covariances(strip, points, at)[fitted])
    towards = np.einsum("in,ni->n", there, axes[:, :, 0])
    normals = axes[:, :, 0].T * -np.copysign(1.0, towards)
    count = at.count[fitted]
    from_plane = np.sqrt(np.maximum(variances[:, 0], 0.0) * count / (count - PLANE_PARAMETERS))
    distance = np.abs(towards) * there[2]  # a deviation of 1/z moves a point by z^2 of it along its ray
    turn = distance * np.sqrt((1.0 / variances[:, 1] + 1.0 / variances[:, 2]) / count)
    images = np.full((6, *fitted.shape), np.nan)
    images[:, fitted] = [*normals, from_plane / distance, distance, turn]
    return (images[0], images[1], images[2]), images[3], images[4], images[5]


def _covariances(strip: _Strip, points: FloatArray, at: _Spread) -> FloatArray:
    """Return the covariance (h, W, 3, 3) of each window's points (3, h, W), centred on the strip to keep digits."""
    one, _, _ = strip.kernels
    centre = np.mean(points, axis=(1, 2), where=strip.usable, keepdims=True)
    centred = np.where(strip.usable, points - centre, 0.0)
    mean = [strip.sums(each, one, one) * at.share for each in centred]
    covariance = np.empty((*at.share.shape, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            product = strip.sums(centred[i] * centred[j], one, one) * at.share - mean[i] * mean[j]
            covariance[..., i, j] = covariance[..., j, i] = product
    return covariance
