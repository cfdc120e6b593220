"""The paper's two-stage fit of Phong parameters: equations (10) and (11)."""

from __future__ import annotations

import numpy as np

from sidelong.errors import InputError
from sidelong.physics.reflectance import Phong
from sidelong.types import FloatArray

FEWEST_SAMPLES = 10
ROUNDING = 1e-9
"""Share of the radiance below which the specular rest is what float64 left of a subtraction, not light."""


def fit_two_stage(radiance: FloatArray, light: FloatArray, cos_theta: FloatArray, cos_alpha: FloatArray) -> Phong:
    """Fit k_d where only diffuse light arrives, then [n, k_s] by log-linear least squares on the rest.

    This is the paper's method to the letter. Its second stage takes logarithms of a difference near zero, so it is
    exact on clean data and biased by noise: at 0.2 % noise k_s of 0.74 comes out near 0.01. It is the baseline that
    :mod:`sidelong.calibration.reflectance.fit` is measured against.

    Parameters
    ----------
    radiance
        (N,) E_calib of equation (9).
    light
        (N,) incident light L_in.
    cos_theta
        (N,) cosine between light and normal.
    cos_alpha
        (N,) cosine between mirror ray and camera ray.

    Raises
    ------
    InputError
        Fewer than ``FEWEST_SAMPLES`` samples beyond alpha = pi/2 (k_d not identifiable), fewer than that with a
        positive specular rest, or all of them at one angle (n not identifiable).
    """
    lit = np.isfinite(radiance) & (cos_theta > 0)
    diffuse = lit & (cos_alpha < 0)
    if diffuse.sum() < FEWEST_SAMPLES:
        raise InputError(
            f"radiance: {int(diffuse.sum())} samples have alpha above pi/2, needs {FEWEST_SAMPLES}: "
            "k_d not identifiable"
        )
    lambertian = (light * cos_theta)[diffuse]
    k_d = float(lambertian @ radiance[diffuse] / (lambertian @ lambertian))
    rest = radiance - k_d * light * cos_theta  # Q of equation (10)
    specular = lit & (cos_alpha > 0) & (rest > ROUNDING * radiance)
    if specular.sum() < FEWEST_SAMPLES:
        raise InputError(
            f"radiance: {int(specular.sum())} samples exceed the diffuse part, needs {FEWEST_SAMPLES}: "
            "n and k_s not identifiable"
        )
    x = np.log(np.minimum(cos_alpha[specular], 1.0))
    y = np.log(rest[specular] / light[specular])  # equation (11)
    if np.ptp(x) < 1e-6:
        raise InputError(f"cos_alpha: ln spans {np.ptp(x):.1e}, needs at least 1e-6: n not identifiable")
    n, log_k_s = np.polyfit(x, y, 1)
    if n < 0:
        raise InputError(f"radiance: the fitted n is {n:.3g}, below 0: the surface has no highlight in these samples")
    return Phong(k_d=max(k_d, 0.0), k_s=float(np.exp(log_k_s)), n=float(n))
