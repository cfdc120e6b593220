"""The views of a part: everything it can look like is near one of them, and nothing is there twice."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sidelong.detection.viewsphere import Ranges, main_axis, views
from sidelong.geometry.symmetry import Symmetry, group_from, no_symmetry
from sidelong.geometry.transforms import look_at, rotation_about

AXIS = np.array([1.0, 2.0, -0.5]) / np.linalg.norm([1.0, 2.0, -0.5])
ACROSS = np.cross(AXIS, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(AXIS, [0.0, 0.0, 1.0]))
FLIP = rotation_about(ACROSS, np.pi)


def _cyclic(fold: int, *others: np.ndarray) -> Symmetry:
    rotations = group_from(np.array([rotation_about(AXIS, 2 * np.pi / fold), *others]))
    assert rotations is not None
    return Symmetry(np.zeros(3), rotations)


CASES = {
    "none": (no_symmetry(np.zeros(3)), 1.0),
    "half turn": (_cyclic(2), 0.5),
    "hexagon head": (_cyclic(6), 1 / 6),
    "hexagon prism": (_cyclic(6, FLIP), 1 / 12),
    "cone": (Symmetry(np.zeros(3), np.eye(3)[None], AXIS), 0.06),
    "cylinder": (Symmetry(np.zeros(3), np.stack([np.eye(3), FLIP]), AXIS), 0.03),
}


def _orientations(symmetry: Symmetry, step_deg: float, roll_step_deg: float) -> np.ndarray:
    return np.concatenate(
        [
            [rotation_about((0, 0, 1), roll) @ look_at(direction, np.zeros(3))[:3, :3].T for roll in rolls]
            for direction, rolls in views(step_deg, roll_step_deg, symmetry)
        ]
    )


@pytest.mark.parametrize("name", CASES)
def test_every_orientation_is_near_one_that_looks_the_same(name: str):
    symmetry, _ = CASES[name]
    trained = _orientations(symmetry, 20.0, 15.0)
    seen = Rotation.random(100, rng=np.random.default_rng(0)).as_matrix()
    apart = [np.degrees(symmetry.angle_rad(trained, one).min()) for one in seen]
    # half a diagonal of the grid of views, and half a turn beside it
    assert max(apart) < np.hypot(10 * np.sqrt(2), 7.5) + 1.0


@pytest.mark.parametrize("name", CASES)
def test_symmetry_divides_the_number_of_templates(name: str):
    symmetry, share = CASES[name]
    count = len(_orientations(symmetry, 12.0, 15.0)) / len(_orientations(no_symmetry(np.zeros(3)), 12.0, 15.0))
    assert count < 1.35 * share


@pytest.mark.parametrize("name", CASES)
def test_no_two_look_the_same(name: str):
    symmetry, _ = CASES[name]
    trained = _orientations(symmetry, 30.0, 30.0)
    for index, one in enumerate(trained[:-1]):
        assert np.degrees(symmetry.angle_rad(trained[index + 1 :], one).min()) > 5.0


def test_a_ball_looks_the_same_from_everywhere():
    ball = Symmetry(np.zeros(3), np.eye(3)[None], ball=True)
    assert [len(rolls) for _, rolls in views(20.0, 15.0, ball)] == [1]


def test_a_cube_is_seen_along_a_fourfold_axis():
    cube = group_from(np.stack([rotation_about((0, 0, 1), np.pi / 2), rotation_about((1, 0, 0), np.pi / 2)]))
    assert cube is not None
    axis = main_axis(Symmetry(np.zeros(3), cube))
    assert axis.fold == 4
    assert axis.reversed_by is not None


ALL = Ranges((-90.0, 90.0), (0.0, 360.0), (0.0, 360.0))
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""``axis_R_object``: z up in the image, looked at along y, from azimuth -90 degrees."""


def allowed(orientation: np.ndarray, symmetry: Symmetry, **ranges: tuple[float, float]) -> bool:
    return bool(replace(ALL, **ranges).allow(orientation[None], symmetry, 2.0)[0])


@pytest.mark.parametrize(
    ("name", "inside", "outside"),
    [
        ("elevation_deg", (-5.0, 5.0), (5.0, 90.0)),
        ("azimuth_deg", (-100.0, -80.0), (-80.0, 260.0)),
        ("azimuth_deg", (260.0, 280.0), (0.0, 260.0)),
        ("roll_deg", (-10.0, 10.0), (10.0, 350.0)),
        ("roll_deg", (350.0, 370.0), (90.0, 180.0)),
    ],
)
def test_a_view_is_made_where_the_ranges_hold_it(name: str, inside: tuple, outside: tuple):
    nothing = no_symmetry(np.zeros(3))
    assert allowed(UPRIGHT, nothing, **{name: inside})
    assert not allowed(UPRIGHT, nothing, **{name: outside})


def test_turned_clockwise_in_the_image_the_roll_rises():
    clockwise = rotation_about((0, 0, 1), np.radians(30.0)) @ UPRIGHT  # x to the right, y down
    assert allowed(clockwise, no_symmetry(np.zeros(3)), roll_deg=(25.0, 35.0))


def test_a_view_that_only_its_equivalent_brings_into_the_ranges_is_made():
    """Of a part with a half turn about z, the view from the front stands for that from behind."""
    half_turn = Symmetry(np.zeros(3), np.stack([np.eye(3), rotation_about((0, 0, 1), np.pi)]))
    behind = {"azimuth_deg": (80.0, 100.0)}
    assert allowed(UPRIGHT, half_turn, **behind)
    assert not allowed(UPRIGHT, no_symmetry(np.zeros(3)), **behind)


def test_all_views_lie_in_the_full_ranges():
    symmetry, _ = CASES["none"]
    assert ALL.allow(_orientations(symmetry, 20.0, 15.0), symmetry, 20.0).all()


def test_the_upper_half_is_about_half_of_the_views():
    symmetry, _ = CASES["none"]
    upper = replace(ALL, elevation_deg=(0.0, 90.0)).allow(_orientations(symmetry, 10.0, 30.0), symmetry, 10.0)
    assert 0.5 <= upper.mean() < 0.62
