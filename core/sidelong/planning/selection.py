"""Which view is next: equations (14) and (15), and the paper's two baselines."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Protocol

import numpy as np

from sidelong.types import Score, View


class StrategyName(StrEnum):
    """How the next view is chosen."""

    NBV = "nbv"
    RANDOM = "random"
    MAX_DISTANCE = "max_distance"


class Strategy(Protocol):
    """Narrows the candidates to those worth scoring; the scan takes the best of them."""

    def shortlist(self, candidates: Sequence[View], taken: Sequence[View]) -> tuple[View, ...]:
        """Return the views to score, at least one of ``candidates`` where there is any."""
        ...


class NextBestView:
    """Score them all: the argmax of equation (14) is over every candidate."""

    def shortlist(self, candidates: Sequence[View], taken: Sequence[View]) -> tuple[View, ...]:
        """Return all candidates."""
        return tuple(candidates)


class RandomView:
    """One candidate at random, the paper's first baseline. The same seed gives the same views."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)

    def shortlist(self, candidates: Sequence[View], taken: Sequence[View]) -> tuple[View, ...]:
        """Return one candidate, each equally likely."""
        return (candidates[int(self._random.integers(len(candidates)))],) if candidates else ()


class MaximumDistance:
    """The candidate farthest from the views already taken, the paper's second baseline.

    "Farthest" is the largest distance to the nearest view taken, between camera centres; ties go to the first.
    """

    def shortlist(self, candidates: Sequence[View], taken: Sequence[View]) -> tuple[View, ...]:
        """Return the farthest candidate."""
        if not candidates:
            return ()
        eyes = np.array([view.base_T_camera[:3, 3] for view in candidates])
        seen = np.array([view.base_T_camera[:3, 3] for view in taken])
        nearest = np.linalg.norm(eyes[:, None] - seen[None], axis=-1).min(axis=1)
        return (candidates[int(np.argmax(nearest))],)


def strategy_of(name: StrategyName, seed: int) -> Strategy:
    """Return the named strategy; the seed matters to Random alone."""
    if name is StrategyName.NBV:
        return NextBestView()
    return RandomView(seed) if name is StrategyName.RANDOM else MaximumDistance()


def best_of(scores: Sequence[Score]) -> Score | None:
    """Return the score with the largest gain, equation (14); ties go to the first, None where none can be taken."""
    possible = [score for score in scores if score.dropped is None]
    return max(possible, key=lambda score: score.gain_px) if possible else None


def below_threshold(gain_px: float, missing_px: int, threshold_px: float, threshold_share: float) -> bool:
    """Say whether G is below G_tau, equation (15), given in pixels or as a share of the missing pixels."""
    return gain_px < max(threshold_px, threshold_share * missing_px)
