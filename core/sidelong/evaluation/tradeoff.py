"""Error against run time: the rows of a comparison as a table and a plot."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sidelong.evaluation.compare import Row
from sidelong.planning.selection import StrategyName


@dataclass(frozen=True)
class Point:
    """Mean of a strategy after some views, over references (and seeds within each reference).

    Attributes
    ----------
    completeness, compute_s, cell_s
        Means over references.
    worst
        Lowest completeness of a reference.
    references
        How many.
    """

    strategy: StrategyName
    views_added: int
    completeness: float
    worst: float
    compute_s: float
    cell_s: float
    references: int


def summarise(rows: Sequence[Row]) -> list[Point]:
    """Return a point for each strategy and number of views, strategies in the order of their first row."""
    points: list[Point] = []
    for strategy in dict.fromkeys(row.strategy for row in rows):
        for views_added in sorted({row.views_added for row in rows if row.strategy is strategy}):
            mine = [row for row in rows if row.strategy is strategy and row.views_added == views_added]
            places = list(dict.fromkeys((row.object, row.scene, row.reference) for row in mine))
            means = np.array(
                [
                    np.mean(
                        [
                            (r.completeness, r.compute_s, r.cell_s)
                            for r in mine
                            if (r.object, r.scene, r.reference) == at
                        ],
                        axis=0,
                    )
                    for at in places
                ]
            )
            completeness, compute_s, cell_s = (float(value) for value in means.mean(axis=0))
            points.append(
                Point(strategy, views_added, completeness, float(means[:, 0].min()), compute_s, cell_s, len(places))
            )
    return points


def draw(points: Sequence[Point], title: str) -> bytes:
    """Draw completeness against views, seconds of computing and seconds of cell time; return a PNG."""
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(12, 3.8), dpi=110, layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for strategy in dict.fromkeys(point.strategy for point in points):
        mine = [point for point in points if point.strategy is strategy]
        y = [100 * point.completeness for point in mine]
        for axis, x in zip(
            axes,
            ([p.views_added for p in mine], [p.compute_s for p in mine], [p.cell_s for p in mine]),
            strict=True,
        ):
            axis.plot(x, y, marker="o", label=strategy.value)
    for axis, label in zip(axes, ("views added", "computing, s", "cell time, s"), strict=True):
        axis.set_xlabel(label)
        axis.set_xlim(left=0)
        axis.grid(alpha=0.3)
    axes[0].set_xticks(sorted({point.views_added for point in points}))
    axes[0].set_ylim(bottom=0)
    axes[0].set_ylabel("completeness, %")
    axes[0].legend()
    figure.suptitle(title)
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()
