"""What errors of disparity were measured, counted so that the fit and its intervals need no pixel again.

An error is filed under its cell (a capture of a plate, or a class of slope), the distance of its pixel from the nearest
one without depth, and its group. Groups are made of whole tiles of the image: errors of one window are alike, those of
different groups are independent, so that leaving out one group after the other tells how sure a fit is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sidelong.types import BoolArray, FloatArray, IntArray

GROUPS = 20
RIM_EDGES_PX = (0.5, 1.5, 2.5, 3.5, 4.5, 6.5, 9.5, np.inf)
LARGEST_SPREADS = 4.0
"""Errors beyond so many robust deviations of their like are outliers, and not counted."""
MAD_TO_SIGMA = 1.4826
MOST_ERRORS = 4_000_000
"""More tell nothing more; rows are left out."""
SMALLEST_TILE_PX, LARGEST_TILE_PX = 8, 64
TILES_PER_GROUP = 6


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of one capture or class of slope.

    Attributes
    ----------
    gradient
        Change of disparity from pixel to pixel, where they were measured.
    error_px
        (N,) in disparity.
    rim_px
        (N,) distance from the nearest pixel without depth.
    group
        (N,) 0 to ``GROUPS - 1``.
    """

    gradient: float
    error_px: FloatArray
    rim_px: FloatArray
    group: IntArray


@dataclass(frozen=True, eq=False)
class Table:
    """Counts and squares of errors by cell, group and distance from the rim.

    Attributes
    ----------
    gradient
        (C,) of the cells.
    rim_px
        (B,) mean distance from the rim, of the errors of each class of it.
    count, square_px2
        (C, G, B) number of errors that are no outliers, and the sum of their squares.
    """

    gradient: FloatArray
    rim_px: FloatArray
    count: FloatArray
    square_px2: FloatArray

    def without_group(self, group: int) -> Table:
        """Return the table as it is without the errors of a group."""
        kept = np.arange(GROUPS) != group
        return Table(self.gradient, self.rim_px, self.count[:, kept], self.square_px2[:, kept])

    def without_cell(self, cell: int) -> Table:
        """Return the table as it is without a cell."""
        kept = np.arange(len(self.gradient)) != cell
        return Table(self.gradient[kept], self.rim_px, self.count[kept], self.square_px2[kept])


def tabulate(cells: Sequence[Errors]) -> Table:
    """File errors."""
    classes = len(RIM_EDGES_PX) - 1
    count, square = np.zeros((2, len(cells), GROUPS, classes))
    rim_total = np.zeros(classes)
    for index, cell in enumerate(cells):
        rim_class = np.digitize(cell.rim_px, RIM_EDGES_PX) - 1
        sound = _sound(cell.error_px, rim_class, classes)
        place = (cell.group * classes + rim_class)[sound]
        count[index] = np.bincount(place, minlength=GROUPS * classes).reshape(GROUPS, classes)
        square[index] = np.bincount(place, cell.error_px[sound] ** 2, minlength=GROUPS * classes).reshape(
            GROUPS, classes
        )
        rim_total += np.bincount(rim_class[sound], cell.rim_px[sound], minlength=classes)
    total = count.sum(axis=(0, 1))
    mean_rim_px = np.where(total > 0, rim_total / np.maximum(total, 1), np.array(RIM_EDGES_PX[:-1]) + 0.5)
    return Table(np.array([cell.gradient for cell in cells]), mean_rim_px, count, square)


def groups_of(rows: IntArray, columns: IntArray) -> IntArray:
    """Return the group (N,) of pixels: tiles as large as leaves enough of them in each group, spread over the image."""
    side_px = int(np.sqrt(len(rows) / (GROUPS * TILES_PER_GROUP)))
    side_px = min(max(side_px, SMALLEST_TILE_PX), LARGEST_TILE_PX)
    return (rows // side_px * 7 + columns // side_px * 3) % GROUPS


def spread_px(error_px: FloatArray) -> float:
    """Return the robust standard deviation of errors about 0."""
    return MAD_TO_SIGMA * float(np.median(np.abs(error_px))) if error_px.size else 0.0


def _sound(error_px: FloatArray, rim_class: IntArray, classes: int) -> BoolArray:
    limits = np.array([LARGEST_SPREADS * spread_px(error_px[rim_class == each]) for each in range(classes)])
    return np.abs(error_px) <= limits[rim_class]
