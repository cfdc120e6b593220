"""What a view shows of each part: boxes in front of each other, at the image's edge, and behind the camera."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sidelong.evaluation.silhouettes import box_of, silhouettes, visible_fractions
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.transforms import look_at, transform
from sidelong.types import FloatArray

CAMERA = PinholeCamera(80, 64, 100.0, 100.0, 39.5, 31.5)
DOWN = transform(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 0.5))
"""0.5 m above the table, looking straight down: the top of a plate at height 0 is cut at 200 px/m."""


@pytest.fixture(scope="module")
def plate() -> Part:
    """100 mm by 100 mm, its top in the plane z = 0: 20 x 20 px, columns and rows 29.5 to 49.5 and 21.5 to 41.5."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.0002))
    return part_from_arrays("plate", np.asarray(mesh.vertices) - (0, 0, 0.0001), np.asarray(mesh.faces, dtype=np.intp))


def at(x_m: float, y_m: float, z_m: float) -> FloatArray:
    return transform(np.eye(3), (x_m, y_m, z_m))


def test_a_part_alone_is_wholly_visible(plate: Part) -> None:
    (seen,) = silhouettes([(plate, at(0, 0, 0))], CAMERA, DOWN)
    assert (seen.all_px, int(seen.visible.sum()), int(seen.covered.sum())) == (400, 400, 400)
    assert seen.box == (30, 22, 20, 20)
    assert seen.visible_fraction == 1.0


def test_what_stands_before_a_part_hides_its_share(plate: Part) -> None:
    """Halfway up a plate is 25 % wider in the image, and shifted by half a width it hides half of the other."""
    shift_m = 0.1 / 2 * 0.8 + 0.01
    fractions = visible_fractions([(plate, at(0, 0, 0)), (plate, at(shift_m, 0, 0.1))], CAMERA, DOWN)
    left_edge_px = 39.5 + (shift_m - 0.05) / 0.4 * 100
    assert fractions[0] == pytest.approx((left_edge_px - 29.5) / 20, abs=1 / 20)
    assert fractions[1] == 1.0


def test_a_part_behind_another_shows_nothing(plate: Part) -> None:
    np.testing.assert_array_equal(
        visible_fractions([(plate, at(0, 0, 0)), (plate, at(0, 0, 0.1))], CAMERA, DOWN), [0, 1]
    )


def test_what_lies_beyond_the_edge_counts_as_hidden(plate: Part) -> None:
    """Its middle on the last column: half of it lies outside, and outside it could be seen."""
    (seen,) = silhouettes([(plate, at(0.2, 0, 0))], CAMERA, DOWN)
    assert seen.all_px == 400
    assert seen.visible_fraction == 0.5
    assert seen.box == (70, 22, 20, 20)


@pytest.mark.parametrize("pose", [at(0, 0, 1.0), at(0, 0, 0.5001), at(5.0, 0, 0)], ids=["behind", "around", "far out"])
def test_a_part_that_cannot_be_seen_has_no_visible_share(plate: Part, pose: FloatArray) -> None:
    np.testing.assert_array_equal(visible_fractions([(plate, pose)], CAMERA, DOWN), [0.0])


def test_no_parts_have_no_silhouettes() -> None:
    assert silhouettes([], CAMERA, DOWN) == ()
    assert visible_fractions([], CAMERA, DOWN).shape == (0,)
    assert box_of(np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)) is None


def test_the_view_it_is_seen_from_matters(plate: Part) -> None:
    """From the side the upper of two plates hides nothing of the lower."""
    stacked = [(plate, at(0, 0, 0)), (plate, at(0, 0, 0.1))]
    side = look_at((0.0, -0.6, 0.05), (0.0, 0.0, 0.05))
    np.testing.assert_array_equal(visible_fractions(stacked, CAMERA, side), [1.0, 1.0])
