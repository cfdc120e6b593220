"""Heaped parts lie in the bin, on the floor or on each other, and hardly overlap; a print has its contrast."""

import numpy as np
import pytest

from sidelong.errors import SettingsError
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import invert, rotation_about, transform, transform_points
from sidelong.simulation.bin import Bin
from sidelong.simulation.heap import CELL_M, heap
from sidelong.simulation.materials import MATERIALS, printed
from sidelong.simulation.parts import PART_NAMES, simulated_part

BASE_T_BIN = transform(rotation_about((0, 0, 1), 0.4), (0.5, -0.1, 0.02))
SMALL = Bin(length_m=0.14, width_m=0.12)


@pytest.mark.parametrize("name", PART_NAMES)
def test_heaped_parts_lie_within_the_walls_and_above_the_floor(name: str):
    part = simulated_part(name)
    poses = heap(part, 12, 3, BASE_T_BIN, SMALL)
    in_bin = [transform_points(invert(BASE_T_BIN) @ pose, part.vertices_m) for pose in poses]
    lowest_m = np.array([points[:, 2].min() for points in in_bin])
    assert lowest_m.min() == pytest.approx(0.0, abs=1e-7)  # rays are float32
    assert (lowest_m > 5e-3).any(), "none lies on another"
    assert max(np.abs(points[:, 0]).max() for points in in_bin) < SMALL.length_m / 2
    assert max(np.abs(points[:, 1]).max() for points in in_bin) < SMALL.width_m / 2


def test_a_later_part_rests_on_what_lies_there_and_does_not_sink_in():
    """Straight down from any point, the part that fell later comes first; overlaps are those of a cell's slope."""
    part = simulated_part("tube_fitting")
    poses = heap(part, 10, 1, BASE_T_BIN, SMALL)
    xy = np.random.default_rng(0).uniform(-0.06, 0.06, (4000, 2))
    starts = transform_points(BASE_T_BIN, np.column_stack([xy, np.full(len(xy), 0.5)]))
    down = np.array([0.0, 0.0, -1.0])
    tops = [RayScene([(part, pose)]).cast(starts, down).distance for pose in poses]
    grounds = np.full(len(starts), 0.5)
    for pose, top in zip(poses, tops, strict=True):
        from_below = transform_points(BASE_T_BIN, np.column_stack([xy, np.full(len(xy), -0.1)]))
        underside = 0.6 - RayScene([(part, pose)]).cast(from_below, -down).distance  # depth below the starts
        met = np.isfinite(top)
        sunk_m = underside[met] - grounds[met]
        assert np.quantile(sunk_m, 0.999) < 6 * CELL_M
        grounds = np.minimum(grounds, top)


def test_the_same_seed_gives_the_same_heap():
    part = simulated_part("gear")
    first, second, other = (heap(part, 5, seed, BASE_T_BIN, SMALL) for seed in (4, 4, 5))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


def test_no_parts_are_no_heap():
    assert heap(simulated_part("gear"), 0, 0, BASE_T_BIN, SMALL) == []


@pytest.mark.parametrize(
    ("count", "length_m", "message"), [(-1, 0.2, "is -1, needs at least 0"), (2, 0.03, "does not fit")]
)
def test_what_cannot_be_thrown_is_refused(count: int, length_m: float, message: str):
    with pytest.raises(SettingsError, match=message):
        heap(simulated_part("eye_bolt"), count, 0, BASE_T_BIN, Bin(length_m=length_m, width_m=0.1))


def test_a_print_swings_about_the_plain_albedo_and_metal_carries_none():
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (20_000, 3))
    material = np.repeat([0, 1], 10_000)
    factor = printed(("printed", "stainless"), material, points)
    assert (factor[10_000:] == 1.0).all()
    contrast = MATERIALS["printed"].print_contrast
    assert factor[:10_000].mean() == pytest.approx(1.0, abs=0.1)
    assert factor[:10_000].std() > contrast / 2
    assert 1 - contrast <= factor.min() <= factor.max() <= 1 + contrast
