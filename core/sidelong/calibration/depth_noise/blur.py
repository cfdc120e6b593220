"""How far the noise of a depth map reaches from pixel to pixel: a matcher that looks at windows blurs it."""

from __future__ import annotations

import numpy as np

from sidelong.types import FloatArray

KERNEL = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
"""Fourth differences: what is left of a surface as curved as parts are is less than any noise."""
LARGEST_BLUR_PX = 4.0
FEWEST_DIFFERENCES = 500
OUTLIER_SPREADS = 4.0
ROUNDING = 1e-12


def noise_blur_px(depth_m: FloatArray) -> float:
    """Return the standard deviation of the Gaussian that has blurred white noise into the noise of a depth map.

    Fourth differences of inverse depth along the rows are correlated from one pixel to the next: by -0.8 for white
    noise, by more the further noise reaches.

    Parameters
    ----------
    depth_m
        (H, W), NaN where missing.

    Returns
    -------
    float
        Pixels, 0 to ``LARGEST_BLUR_PX``; 0 where there are too few neighbours with depth to tell, or no noise.
    """
    inverse = 1.0 / depth_m
    width = inverse.shape[1]
    reach = len(KERNEL) - 1
    if width <= reach + 1:
        return 0.0
    differences = sum(
        weight * inverse[:, offset : width - reach + offset] for offset, weight in enumerate(KERNEL)
    )  # fmt: skip
    first, second = np.asarray(differences)[:, :-1], np.asarray(differences)[:, 1:]
    both = np.isfinite(first) & np.isfinite(second)
    if both.sum() < FEWEST_DIFFERENCES:
        return 0.0
    first, second = first[both], second[both]
    # edges are no noise
    limit = OUTLIER_SPREADS * 1.4826 * float(np.median(np.abs(first)))
    inside = (np.abs(first) < limit) & (np.abs(second) < limit)
    power = float((first[inside] ** 2).mean()) if inside.any() else 0.0
    if not np.sqrt(power) > ROUNDING * float(np.nanmedian(inverse)):
        return 0.0
    measured = float((first[inside] * second[inside]).mean()) / power
    blurs = np.linspace(0.0, LARGEST_BLUR_PX, 161)
    expected = np.array([_neighbour_correlation(blur) for blur in blurs])
    return float(np.interp(measured, expected, blurs))


def _neighbour_correlation(blur_px: float) -> float:
    """Return the correlation of neighbouring fourth differences of white noise blurred by a Gaussian."""
    own = np.correlate(KERNEL, KERNEL, mode="full")
    lags = np.arange(len(own)) - len(KERNEL) + 1

    def covariance(shift: int) -> float:
        apart = (lags + shift).astype(np.float64)
        noise = np.exp(-(apart**2) / (4 * blur_px**2)) if blur_px > 0.05 else (apart == 0).astype(np.float64)
        return float((own * noise).sum())

    return covariance(1) / covariance(0)
