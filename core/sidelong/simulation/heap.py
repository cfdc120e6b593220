"""Parts thrown into a bin one after another: each comes to lie on the floor or on those before it.

No dynamics: a part keeps the orientation it is given and sinks until it touches. That is enough to make parts hide each
other and lie tilted, which is what detection and planning have to cope with.
"""

from __future__ import annotations

import math

import numpy as np

from sidelong.errors import SettingsError
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import rotation_about, transform
from sidelong.simulation.bin import GAP_M, Bin, resting_rotations
from sidelong.types import FloatArray

CELL_M = 0.5e-3
"""Cells of the height map on which parts come to lie; below it they may touch or overlap by a hair."""
PLACES = 12
"""Random places looked at for each part; it takes the lowest, as thrown parts do."""
LARGEST_TILT_RAD = math.radians(30.0)
"""Of a part that lies on others, from the way it would rest on a plane."""


def heap(part: Part, count: int, seed: int, base_T_bin: FloatArray, bin_: Bin) -> list[FloatArray]:
    """Throw parts into a bin and return ``base_T_object`` (4, 4) of each, in the order they fell.

    Parameters
    ----------
    part
        The part.
    count
        How many, at least 0.
    seed
        Same seed, same heap.
    base_T_bin
        (4, 4) pose of the bin in the base frame.
    bin_
        Its sizes.

    Raises
    ------
    SettingsError
        The count is negative, or the part is longer than the bin.
    """
    if count < 0:
        raise SettingsError(f"heap count: is {count}, needs at least 0")
    rng = np.random.default_rng(seed)
    thrown = _Thrown(part, *resting_rotations(part))
    inner_m = np.array([bin_.length_m, bin_.width_m]) - 2 * GAP_M
    heights = np.zeros((max(1, int(inner_m[0] / CELL_M)), max(1, int(inner_m[1] / CELL_M))))
    poses: list[FloatArray] = []
    for _ in range(count):
        shape, (row, column), z_m = thrown.into(heights, rng)
        shape.lay(heights, (row, column), z_m)
        x_m, y_m = np.array([row, column]) * CELL_M - inner_m / 2 - shape.corner_m[:2]
        poses.append(base_T_bin @ transform(shape.rotation, (x_m, y_m, z_m - shape.corner_m[2])))
    return poses


class _Shape:
    """A turned part as seen from straight below and above: heights (X, Y) over its lowest point.

    Attributes
    ----------
    rotation
        (3, 3) of the part.
    corner_m
        (3,) least coordinates of the turned part.
    low, high
        (X, Y) under and upper side; infinite and minus infinite beside the part.
    """

    def __init__(self, part: Part, rotation: FloatArray) -> None:
        points = part.vertices_m @ rotation.T
        least: FloatArray = points.min(axis=0)
        size_m: FloatArray = points.max(axis=0) - least
        cells = _cells(size_m[0]), _cells(size_m[1])
        grid = least[:2] + CELL_M * np.moveaxis(np.indices(cells, dtype=np.float64), 0, -1)
        scene = RayScene([(part, transform(rotation, np.zeros(3)))])
        above = np.dstack([grid, np.full(cells, least[2] + 2 * size_m[2])])
        below = np.dstack([grid, np.full(cells, least[2] - size_m[2])])
        self.rotation, self.corner_m = rotation, least
        self.low = scene.cast(below, np.array([0.0, 0.0, 1.0])).distance - size_m[2]
        self.high = 2 * size_m[2] - scene.cast(above, np.array([0.0, 0.0, -1.0])).distance

    def fits(self, heights: FloatArray) -> bool:
        """Say whether the part lies within the height map at some place."""
        return self.low.shape[0] <= heights.shape[0] and self.low.shape[1] <= heights.shape[1]

    def lowest_of(self, heights: FloatArray, rng: np.random.Generator) -> Place:
        """Return, of some random places, the one where the part comes to lie lowest."""
        rows, columns = heights.shape[0] - self.low.shape[0] + 1, heights.shape[1] - self.low.shape[1] + 1
        corners = [(int(rng.random() * rows), int(rng.random() * columns)) for _ in range(PLACES)]
        rests_m = [max(0.0, float((self._under(heights, corner) - self.low).max())) for corner in corners]
        lowest = int(np.argmin(rests_m))
        return self, corners[lowest], rests_m[lowest]

    def lay(self, heights: FloatArray, corner: tuple[int, int], z_m: float) -> None:
        """Raise the height map to the part's upper side."""
        under = self._under(heights, corner)
        under[:] = np.maximum(under, z_m + self.high)

    def _under(self, heights: FloatArray, corner: tuple[int, int]) -> FloatArray:
        (row, column), (rows, columns) = corner, self.low.shape
        return heights[row : row + rows, column : column + columns]


Place = tuple[_Shape, tuple[int, int], float]
"""A turned part, its corner in the height map, and how high above the floor its lowest point comes to lie."""


class _Thrown:
    """A part that is thrown again and again."""

    def __init__(self, part: Part, resting: FloatArray, likelihood: FloatArray) -> None:
        self._part, self._resting, self._likelihood = part, resting, likelihood

    def into(self, heights: FloatArray, rng: np.random.Generator) -> Place:
        """Throw it; where it lies on others it is tilted. Raises SettingsError where it is longer than the bin."""
        for _ in range(PLACES):
            resting = self._resting[rng.choice(len(self._resting), p=self._likelihood)]
            spun = rotation_about((0.0, 0.0, 1.0), rng.uniform(0, 2 * math.pi)) @ resting
            flat, tilted = _Shape(self._part, spun), _Shape(self._part, _tilt(rng) @ spun)
            if flat.fits(heights) and tilted.fits(heights):
                place = flat.lowest_of(heights, rng)
                return place if place[2] < 2 * CELL_M else tilted.lowest_of(heights, rng)
        length_mm, width_mm = (1e3 * CELL_M * cells for cells in heights.shape)
        raise SettingsError(
            f"heap: {self._part.name} is {self._part.diameter_m * 1e3:.3g} mm long, the bin {length_mm:.3g} x "
            f"{width_mm:.3g} mm: it does not fit"
        )


def _cells(length_m: float) -> int:
    return int(length_m / CELL_M) + 2


def _tilt(rng: np.random.Generator) -> FloatArray:
    turn_rad = rng.uniform(0, 2 * math.pi)
    return rotation_about((math.cos(turn_rad), math.sin(turn_rad), 0.0), rng.uniform(0, LARGEST_TILT_RAD))
