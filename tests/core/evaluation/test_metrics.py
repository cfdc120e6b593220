"""Completeness against the truth: which pixels count, and which of them are recovered, in closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sidelong.errors import DepthError
from sidelong.evaluation.metrics import Truth, truth_of
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.transforms import look_at, transform
from sidelong.types import BoolArray, FloatArray

NAN = np.nan
CAMERA = PinholeCamera(80, 64, 100.0, 100.0, 39.5, 31.5)
DOWN = transform(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 0.5))
"""0.5 m above the table, looking straight down."""


def row(*depths_m: float) -> FloatArray:
    return np.array([depths_m])


def flags(text: str) -> BoolArray:
    return np.array([[letter == "x" for letter in text]])


def truth(depth_m: FloatArray, on_parts: str | None = None, measured: str | None = None) -> Truth:
    count = depth_m.size
    return Truth(depth_m, flags(on_parts or "x" * count), flags(measured or "." * count))


def test_only_part_pixels_without_measured_depth_and_with_known_truth_are_missing() -> None:
    here = truth(row(0.5, 0.5, 0.5, NAN, 0.5), on_parts="xx.xx", measured=".x..x")
    np.testing.assert_array_equal(here.missing, flags("x...."))


def test_completeness_is_the_share_of_the_missing_pixels_that_are_recovered() -> None:
    """Of eight pixels two were measured and one lies beside the part: two of five are right, 1 mm too far and near."""
    here = truth(np.full((1, 8), 0.5), on_parts="xxxxxxx.", measured="xx......")
    completed_m = row(0.5, 0.5, 0.501, 0.499, 0.51, NAN, 0.49, 0.5)
    np.testing.assert_array_equal(here.recovered(completed_m), flags("..xx...."))
    assert here.completeness(completed_m) == pytest.approx(2 / 5)


def test_nothing_and_everything_completed_are_0_and_1() -> None:
    here = truth(np.linspace(0.4, 0.6, 7)[None])
    assert here.completeness(np.full((1, 7), NAN)) == 0.0
    assert here.completeness(here.depth_m.copy()) == 1.0


@pytest.mark.parametrize(
    ("truth_m", "completed_m"),
    [(0.002, 0.004), (0.004, 0.002)],  # 4 mm - 2 mm is 2 mm to the last bit: doubling is exact
    ids=["too far", "too near"],
)
def test_an_error_of_2_mm_is_no_recovery_and_anything_below_is(truth_m: float, completed_m: float) -> None:
    here = truth(row(truth_m))
    nearer_m = np.nextafter(completed_m, truth_m)
    assert abs(completed_m - truth_m) == 0.002
    assert here.completeness(row(completed_m)) == 0.0
    assert here.completeness(row(nearer_m)) == 1.0


@pytest.mark.parametrize("value", [NAN, np.inf, -np.inf])
def test_a_completed_depth_that_is_no_number_recovers_nothing(value: float) -> None:
    assert truth(row(0.5, 0.5)).completeness(row(value, 0.5)) == 0.5


def test_where_the_truth_is_unknown_a_depth_near_zero_recovers_nothing() -> None:
    here = truth(row(NAN, 0.5))
    np.testing.assert_array_equal(here.recovered(row(0.0, 0.5)), flags(".x"))


@pytest.mark.parametrize(
    ("here", "on_parts_px"),
    [
        (truth(row(0.5, 0.5, 0.5), measured="xxx"), 3),
        (truth(row(0.5, 0.5, 0.5), on_parts=".x.", measured=".x."), 1),
        (truth(row(NAN, NAN, 0.5), measured="..x"), 3),
        (truth(row(0.5), on_parts="."), 0),
    ],
    ids=["all measured", "measured on the part", "truth unknown", "no part"],
)
def test_where_no_pixel_is_missing_completeness_has_no_meaning(here: Truth, on_parts_px: int) -> None:
    with pytest.raises(DepthError, match=f"truth: 0 of {on_parts_px} part pixels lack depth .* limit 1"):
        here.completeness(row(*np.full(here.depth_m.size, 0.5)))


# --- which pixels show a part ---


@pytest.fixture(scope="module")
def block() -> Part:
    """A cube of 0.1 m, its middle in the origin: its top is 0.45 m from the camera, 22 pixels wide."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    return part_from_arrays("block", np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.intp))


def seen(block: Part, depth_m: FloatArray, pose: FloatArray | None = None) -> Truth:
    measured = np.zeros(depth_m.shape, dtype=bool)
    return truth_of(depth_m, measured, [(block, np.eye(4) if pose is None else pose)], (CAMERA, DOWN))


TOP_M = 0.45


def square() -> BoolArray:
    """The pixels whose centres see the top: |x| <= 0.05 m at 0.45 m is 11.1 pixels to each side."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    half_px = 100.0 * 0.05 / TOP_M
    return (np.abs(u - 39.5) <= half_px) & (np.abs(v - 31.5) <= half_px)


def test_a_part_is_where_its_rendering_meets_the_true_depth(block: Part) -> None:
    depth_m = np.where(square(), TOP_M, 0.55)
    here = seen(block, depth_m)
    assert square().sum() == 22 * 22
    np.testing.assert_array_equal(here.on_parts, square())
    np.testing.assert_array_equal(here.missing, square())
    assert here.completeness(depth_m) == 1.0


@pytest.mark.parametrize(
    ("offset_m", "on_part"), [(2.99e-3, True), (-2.99e-3, True), (3.01e-3, False), (-3.01e-3, False)]
)
def test_true_depth_may_differ_from_the_rendering_by_3_mm(block: Part, offset_m: float, on_part: bool) -> None:
    depth_m = np.full((CAMERA.height, CAMERA.width), TOP_M + offset_m)
    np.testing.assert_array_equal(seen(block, depth_m).on_parts, square() & on_part)


def test_what_stands_before_a_part_is_not_the_part(block: Part) -> None:
    depth_m = np.where(square(), TOP_M, 0.55)
    depth_m[:, :40] = np.minimum(depth_m[:, :40], 0.40)
    expected = square()
    expected[:, :40] = False
    np.testing.assert_array_equal(seen(block, depth_m).on_parts, expected)


def test_of_two_parts_the_nearer_one_is_seen(block: Part) -> None:
    """A second cube 0.1 m higher stands before the first: pixels with the first one's depth show neither."""
    depth_m = np.full((CAMERA.height, CAMERA.width), TOP_M)
    above = transform(np.eye(3), (0.0, 0.0, 0.1))
    here = truth_of(depth_m, np.zeros(depth_m.shape, dtype=bool), [(block, np.eye(4)), (block, above)], (CAMERA, DOWN))
    assert not here.on_parts.any()


def test_a_pixel_without_true_depth_shows_no_part(block: Part) -> None:
    depth_m = np.full((CAMERA.height, CAMERA.width), TOP_M)
    depth_m[31, 39] = NAN
    here = seen(block, depth_m)
    assert not here.on_parts[31, 39]
    assert here.on_parts.sum() == 22 * 22 - 1


def test_a_part_that_is_moved_or_out_of_sight_is_not_where_it_was(block: Part) -> None:
    depth_m = np.full((CAMERA.height, CAMERA.width), TOP_M)
    moved = seen(block, depth_m, transform(np.eye(3), (0.09, 0.0, 0.0)))
    np.testing.assert_array_equal(moved.on_parts, np.roll(square(), 20, axis=1))
    assert not seen(block, depth_m, transform(np.eye(3), (2.0, 0.0, 0.0))).on_parts.any()


def test_measured_pixels_are_kept_from_the_missing_ones(block: Part) -> None:
    depth_m = np.full((CAMERA.height, CAMERA.width), TOP_M)
    measured = np.zeros(depth_m.shape, dtype=bool)
    measured[:, :40] = True
    here = truth_of(depth_m, measured, [(block, np.eye(4))], (CAMERA, DOWN))
    np.testing.assert_array_equal(here.missing, square() & ~measured)


def test_the_view_it_is_seen_from_matters(block: Part) -> None:
    """From the side of 0.5 m the face of the cube stands 0.45 m away, from 0.6 m it does not."""
    depth_m = np.full((CAMERA.height, CAMERA.width), TOP_M)
    none = np.zeros(depth_m.shape, dtype=bool)
    for distance_m, expected_px in ((0.5, 22 * 22), (0.6, 0)):
        seen_from = CAMERA, look_at((distance_m, 0.0, 0.0), (0.0, 0.0, 0.0))
        assert truth_of(depth_m, none, [(block, np.eye(4))], seen_from).on_parts.sum() == expected_px
