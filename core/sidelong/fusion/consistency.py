"""Whether views agree: those that do not are refused, and single depths that others prove wrong are marked."""

from __future__ import annotations

import numpy as np

from sidelong.fusion.engine import PosedDepth, common_noise
from sidelong.fusion.settings import FusionSettings
from sidelong.fusion.vote_kernels import count_verdicts, mark_hidden, vote_on_measured
from sidelong.fusion.warping.warp import motion_of, trust_of
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import invert
from sidelong.kernels import strips
from sidelong.types import BoolArray, Float32Array

STRIDE_PX = 6
"""Every so many-th row and column is asked whether views agree."""
MOST_COMMON = 2.0
LEAST_VERDICTS = 100
"""Fewer points that could be contradicted tell nothing of a view."""


def agreement(view: PosedDepth, reference: PosedDepth, camera: PinholeCamera, settings: FusionSettings) -> float:
    """Return which share of the depths of two views is not contradicted by the other; NaN where they share too few.

    A depth is contradicted where the other view measured something well behind it: with true poses that are outliers
    alone, with a view that is 50 mm off half of what both saw.
    """
    supported, seen_through = 0, 0
    limits = np.array([settings.agreement_sigmas, settings.through_m], dtype=np.float32)
    ways = (view, reference, view.reference_T_view), (reference, view, invert(view.reference_T_view))
    for asked, other, other_T_asked in ways:
        motion = motion_of(camera, other_T_asked)[None, :4]
        counts = count_verdicts(asked.depth_m, asked.sigma_m, other.depth_m[None], motion, limits, STRIDE_PX)
        supported, seen_through = supported + counts[0], seen_through + counts[1]
    total = supported + seen_through
    return supported / total if total >= LEAST_VERDICTS else float("nan")


class Contradictions:
    """What further views say of the depths that the reference measured, added up as log-odds.

    A view speaks for a depth where it measured that surface too, and against it where it saw through that point, or
    where it measured something before it that the reference saw through.

    Parameters
    ----------
    reference
        The reference's depth map.
    camera
        Of all views.
    settings
        How.
    """

    def __init__(self, reference: PosedDepth, camera: PinholeCamera, settings: FusionSettings) -> None:
        self._reference = reference
        self._camera = camera
        self._settings = settings
        self._odds = trust_of(reference.depth_m, camera, settings)
        self._sigma_m = _of_surfaces(reference)
        self._spike = (self._odds == 0) & np.isfinite(reference.depth_m)

    def add(self, view: PosedDepth) -> None:
        """Take the votes of one more view."""
        s, own = self._settings, self._reference
        limits = np.array([s.agreement_sigmas, s.through_m, s.noise.trust], dtype=np.float32)
        back = motion_of(self._camera, invert(view.reference_T_view))[None, :4]
        hidden = np.zeros(self._odds.shape, dtype=np.bool_)
        strips(
            lambda first, last: vote_on_measured(
                own.depth_m, self._sigma_m, view.depth_m[None], back, limits, self._odds, first, last
            ),
            len(self._odds),
            each=4,
        )
        motion = motion_of(self._camera, view.reference_T_view)[:4]
        surface = own.depth_m, self._sigma_m, self._spike
        strips(
            lambda first, last: mark_hidden(view.depth_m, surface, motion, limits, hidden, first, last),
            len(view.depth_m),
            each=4,
        )
        self._odds[hidden] -= limits[2]

    @property
    def contradicted(self) -> BoolArray:
        """(H, W) measured pixels against which more was said than for them."""
        return self._odds < 0


def _of_surfaces(view: PosedDepth) -> Float32Array:
    """Return the standard deviation (H, W), at most a few times what is common at that depth.

    An outlier looks like a steep slope: taken for one, it would be let off for the noise of slopes.
    """
    common = common_noise(view.depth_m, view.sigma_m)
    return np.minimum(view.sigma_m, np.float32(MOST_COMMON * common) * view.depth_m**2) if common else view.sigma_m
