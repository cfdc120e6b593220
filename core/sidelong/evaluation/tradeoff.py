"""Error against run time: the rows of a comparison as a table and a plot."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sidelong.evaluation.compare import Row
from sidelong.evaluation.depth_score import DepthErrors
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
    refined: bool
    views_added: int
    completeness: float
    worst: float
    compute_s: float
    cell_s: float
    references: int

    @property
    def label(self) -> str:
        """Strategy, and that its poses stayed as detected where they did."""
        return label_of(self.strategy.value, self.refined)


@dataclass(frozen=True)
class PosePoint:
    """Poses of a strategy after some views, over all objects of all references (and seeds).

    Attributes
    ----------
    label
        Of the strategy; views_added 0 is the reference view alone.
    rate, add_m
        Correct over detected objects, and the mean ADD of the correct ones: the paper's Table 2.
    rate_symmetric, add_symmetric_m, mssd_m
        The same modulo the part's symmetry, with the mean MSSD of the correct ones.
    recall
        Found over sufficiently visible parts, modulo symmetry.
    compute_s
        Mean over references.
    """

    label: str
    views_added: int
    rate: float
    add_m: float
    rate_symmetric: float
    add_symmetric_m: float
    mssd_m: float
    recall: float
    compute_s: float


@dataclass(frozen=True)
class DepthPoint:
    """Errors of the depth of a strategy after some views, over all references (and seeds).

    Attributes
    ----------
    label
        Of the strategy; views_added 0 is the reference view alone.
    on_parts
        Whether of the pixels on parts only.
    completed, measured
        Of what further views gave and of what the reference view measured itself: pixels are the mean number, all else
        means weighted by it.
    """

    label: str
    views_added: int
    on_parts: bool
    completed: DepthErrors
    measured: DepthErrors


def label_of(name: str, refined: bool) -> str:
    """Return what a strategy is called in tables and plots."""
    return name if refined else f"{name} unrefined"


def summarise(rows: Sequence[Row]) -> list[Point]:
    """Return a point for each strategy and number of views, strategies in the order of their first row."""
    points: list[Point] = []
    for (strategy, refined, views_added), mine in _groups(rows):
        places = list(dict.fromkeys((row.object, row.scene, row.reference) for row in mine))
        means = np.array(
            [
                np.mean(
                    [(r.completeness, r.compute_s, r.cell_s) for r in mine if (r.object, r.scene, r.reference) == at],
                    axis=0,
                )
                for at in places
            ]
        )
        completeness, compute_s, cell_s = (float(value) for value in means.mean(axis=0))
        worst = float(means[:, 0].min())
        if views_added > 0:
            points.append(Point(strategy, refined, views_added, completeness, worst, compute_s, cell_s, len(places)))
    return points


def summarise_poses(rows: Sequence[Row]) -> list[PosePoint]:
    """Return a point for each strategy and number of views of the rows whose poses were judged.

    The reference view alone is the same for all strategies and listed once for refined and unrefined poses each.
    """
    points: list[PosePoint] = []
    for label, views_added, mine in _judged(rows):
        scores = [row.poses for row in mine if row.poses is not None]
        if not scores:
            continue
        detected, correct, symmetric, visible, found = (
            sum(getattr(score, name) for score in scores)
            for name in ("detected", "correct", "correct_symmetric", "visible", "found")
        )
        means = {
            name: _mean([(getattr(score, name), getattr(score, counted)) for score in scores])
            for name, counted in (
                ("add_m", "correct"),
                ("add_symmetric_m", "correct_symmetric"),
                ("mssd_m", "correct_symmetric"),
            )
        }
        points.append(
            PosePoint(
                label=label,
                views_added=views_added,
                rate=_share(correct, detected),
                rate_symmetric=_share(symmetric, detected),
                recall=_share(found, visible),
                compute_s=float(np.mean([row.compute_s for row in mine])),
                **means,
            )
        )
    return points


def summarise_depth(rows: Sequence[Row]) -> list[DepthPoint]:
    """Return two points, on parts and everywhere, for each strategy and number of views whose depth was judged.

    The reference view alone is listed as in :func:`summarise_poses`.
    """
    points: list[DepthPoint] = []
    for label, views_added, mine in _judged(rows):
        scores = [row.depth for row in mine if row.depth is not None]
        if not scores:
            continue
        on_parts = [s.completed_on_parts for s in scores], [s.measured_on_parts for s in scores]
        everywhere = [s.completed for s in scores], [s.measured for s in scores]
        for where, (completed, measured) in ((True, on_parts), (False, everywhere)):
            points.append(DepthPoint(label, views_added, where, _pooled(completed), _pooled(measured)))
    return points


def _pooled(errors: Sequence[DepthErrors]) -> DepthErrors:
    """Return the mean number of pixels, and the means of all else weighted by their numbers."""
    names = [name for name in DepthErrors.model_fields if name != "pixels"]
    means = {name: _mean([(getattr(each, name), each.pixels) for each in errors]) for name in names}
    known = {name: None if math.isnan(value) else value for name, value in means.items()}
    return DepthErrors(pixels=round(float(np.mean([each.pixels for each in errors]))), **known)


Key = tuple[StrategyName, bool, int]


def _judged(rows: Sequence[Row]) -> Iterator[tuple[str, int, list[Row]]]:
    """Yield label, number of views and rows of each strategy; the reference view alone, once for each kind of poses."""
    alone: set[bool] = set()
    for (strategy, refined, views_added), mine in _groups(rows):
        if views_added > 0:
            yield label_of(strategy.value, refined), views_added, mine
        elif refined not in alone:
            alone.add(refined)
            yield label_of("single view", refined), 0, mine


def _groups(rows: Sequence[Row]) -> list[tuple[Key, list[Row]]]:
    """Return the rows of each strategy and number of views, strategies in the order of their first row."""
    groups: dict[Key, list[Row]] = {}
    runs = list(dict.fromkeys((row.strategy, row.refined) for row in rows))
    for row in sorted(rows, key=lambda row: (runs.index((row.strategy, row.refined)), row.views_added)):
        groups.setdefault((row.strategy, row.refined, row.views_added), []).append(row)
    return list(groups.items())


def _mean(values: Sequence[tuple[float | None, int]]) -> float:
    """Return the mean of means weighted by their counts; NaN where nothing was counted."""
    counted = [(value, count) for value, count in values if value is not None]
    total = sum(count for _, count in counted)
    return sum(value * count for value, count in counted) / total if total else float("nan")


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


def draw(points: Sequence[Point], title: str) -> bytes:
    """Draw completeness against views, seconds of computing and seconds of cell time; return a PNG."""
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(12, 3.8), dpi=110, layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for label in dict.fromkeys(point.label for point in points):
        mine = [point for point in points if point.label == label]
        y = [100 * point.completeness for point in mine]
        for axis, x in zip(
            axes,
            ([p.views_added for p in mine], [p.compute_s for p in mine], [p.cell_s for p in mine]),
            strict=True,
        ):
            axis.plot(x, y, marker="o", label=label)
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
