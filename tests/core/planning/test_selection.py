"""Equations (14) and (15), and the two baselines."""

from __future__ import annotations

import numpy as np
import pytest

from sidelong.geometry.transforms import transform
from sidelong.planning.selection import (
    MaximumDistance,
    NextBestView,
    RandomView,
    StrategyName,
    below_threshold,
    best_of,
    strategy_of,
)
from sidelong.types import Score, View


def view(name: str, x: float, y: float = 0.0) -> View:
    return View(name, transform(np.eye(3), (x, y, 0.7)))


LINE = [view(f"x{x}", float(x)) for x in range(5)]


def test_the_next_best_view_is_the_argmax_over_all_candidates_that_can_be_taken() -> None:
    assert NextBestView().shortlist(LINE, LINE[:1]) == tuple(LINE)
    scores = [Score(LINE[0], 9.0, dropped="unreachable"), Score(LINE[1], 3.0), Score(LINE[2], 5.0), Score(LINE[3], 5.0)]
    best = best_of(scores)
    assert best is not None
    assert best.view.name == "x2"
    assert best_of(scores[:1]) is None
    assert best_of([]) is None


def test_random_is_uniform_repeats_with_its_seed_and_differs_between_seeds() -> None:
    draws = [strategy_of(StrategyName.RANDOM, seed).shortlist(LINE, [])[0].name for seed in range(2000)]
    assert draws == [RandomView(seed).shortlist(LINE, [])[0].name for seed in range(2000)]
    counts = np.array([draws.count(item.name) for item in LINE])
    # each is binomial(2000, 1/5): mean 400, standard deviation 17.9
    assert (np.abs(counts - 400) < 90).all()


def test_maximum_distance_takes_the_view_farthest_from_all_taken() -> None:
    strategy = MaximumDistance()
    assert strategy.shortlist(LINE[1:], [LINE[0]])[0].name == "x4"
    # the middle is farther from both ends than anything else
    assert strategy.shortlist(LINE[1:4], [LINE[0], LINE[4]])[0].name == "x2"


@pytest.mark.parametrize("strategy", [NextBestView(), RandomView(0), MaximumDistance()])
def test_without_candidates_nothing_is_shortlisted(strategy: NextBestView | RandomView | MaximumDistance) -> None:
    assert strategy.shortlist([], [LINE[0]]) == ()


@pytest.mark.parametrize(
    ("gain", "pixels", "share", "ends"),
    [
        (10, 0, 0, False),
        (10, 10, 0, False),
        (10, 10.5, 0, True),
        (10, 0, 0.1, False),
        (10, 0, 0.11, True),
        (0, 0, 0, False),
    ],
)
def test_the_threshold_is_given_in_pixels_or_as_a_share_of_the_missing(
    gain: float, pixels: float, share: float, ends: bool
) -> None:
    assert below_threshold(gain, 100, pixels, share) is ends
