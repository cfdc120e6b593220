"""The white image of shifted patterns: the maximum, whether the dots covered the pixels, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sidelong.calibration.white_pattern import UNCOVERED_LIMIT, WhiteImage, WhitePattern
from sidelong.errors import ImageError
from sidelong.geometry.mesh import part_from_arrays
from sidelong.geometry.transforms import look_at
from sidelong.simulation.lofting import loft, rectangle_ring
from sidelong.simulation.pattern import PatternSettings
from sidelong.simulation.rig import rig_for
from sidelong.simulation.sensor import ActiveStereoSensor, SensorSettings
from sidelong.types import Projector

SIZE = (120, 160)


def white(images: list[np.ndarray]) -> WhiteImage:
    pattern = WhitePattern()
    for image in images:
        pattern.add(image)
    return pattern.result()


def flashes(count: int, share: float, seed: int = 0, noise: float = 0.0) -> list[np.ndarray]:
    """Images whose pixels are bright (200) or dark (20), each independently with probability ``share``."""
    random = np.random.default_rng(seed)
    clean = [np.where(random.random(SIZE) < share, 200.0, 20.0) for _ in range(count)]
    return [np.rint(image + noise * random.standard_normal(SIZE)).astype(np.uint8) for image in clean]


@given(arrays.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 5), st.integers(1, 5))))
def test_image_and_dark_are_maximum_and_minimum_over_time(stack: np.ndarray) -> None:
    found = white(list(stack))
    np.testing.assert_array_equal(found.image, stack.max(axis=0))
    np.testing.assert_array_equal(found.dark, stack.min(axis=0))
    assert found.image.dtype == found.dark.dtype == np.uint8
    assert found.images == len(stack)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("noise", [0.0, 2.0])
@pytest.mark.parametrize("count", [3, 4, 8, 16])
def test_independent_dots_leave_the_binomial_share_uncovered(count: int, share: float, noise: float) -> None:
    """Never covered are (1 - p)^N; those always covered change as little, and are not judged either."""
    never, always = (1 - share) ** count, share**count
    found = white(flashes(count, share, noise=noise))
    assert found.unmodulated_share == pytest.approx(never + always, abs=0.01)
    assert found.uncovered_share == pytest.approx(never / (1 - always), rel=0.15, abs=0.001)


@pytest.mark.parametrize(("count", "share", "warns"), [(3, 0.5, True), (4, 0.5, True), (8, 0.5, False), (8, 0.2, True)])
def test_too_few_images_are_warned_of(count: int, share: float, warns: bool) -> None:
    found = white(flashes(count, share))
    if warns:
        assert found.warning is not None
        assert f"in {count} images" in found.warning
        assert "limit 2%" in found.warning
    else:
        assert found.warning is None


def test_shadow_black_and_saturated_pixels_are_counted_apart() -> None:
    images = flashes(16, 0.5, noise=1.0)
    alone = white(images).uncovered_share
    for image in images:
        image[:30] = 3  # shadow
        image[30:60] = 255  # saturated
    found = white(images)
    assert found.unmodulated_share == pytest.approx(0.5, abs=0.001)
    assert alone is not None
    assert found.uncovered_share == pytest.approx(alone, abs=0.001)
    assert found.warning is None


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_images_work_and_tell_nothing(count: int) -> None:
    images = flashes(count, 0.5)
    found = white(images)
    np.testing.assert_array_equal(found.image, np.max(images, axis=0))
    assert found.uncovered_share is None
    assert found.warning is not None
    assert f"{count} images do not tell" in found.warning


def test_a_pattern_that_stands_still_is_warned_of() -> None:
    found = white(flashes(1, 0.5) * 16)
    assert found.uncovered_share is None
    assert found.unmodulated_share == 1.0
    assert found.warning is not None
    assert "0 px change" in found.warning


def test_results_between_are_those_of_the_images_so_far_and_stay_as_they_are() -> None:
    images = flashes(6, 0.5, noise=2.0)
    pattern = WhitePattern()
    for image in images[:4]:
        pattern.add(image)
    early = pattern.result()
    kept = early.image.copy()
    before = [image.copy() for image in images]
    for image in images[4:]:
        pattern.add(image)
    late = pattern.result()
    np.testing.assert_array_equal(early.image, kept)
    assert early.uncovered_share == white(images[:4]).uncovered_share
    assert late.uncovered_share == white(images[::-1]).uncovered_share
    np.testing.assert_array_equal(before, images)


def test_an_image_that_its_owner_overwrites_is_not_kept() -> None:
    pattern, buffer = WhitePattern(), np.full(SIZE, 90, dtype=np.uint8)
    pattern.add(buffer)
    buffer[:] = 10
    pattern.add(buffer)
    assert (pattern.result().image == 90).all()
    assert (pattern.result().dark == 10).all()


def test_without_images_there_is_no_result() -> None:
    with pytest.raises(ImageError, match="0 images were added, needs at least 1"):
        WhitePattern().result()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros(SIZE, dtype=np.uint16), r"image 2 is uint16 of shape \(120, 160\), needs uint8"),
        (np.zeros(SIZE), "image 2 is float64"),
        (np.zeros((*SIZE, 3), dtype=np.uint8), r"image 2 is uint8 of shape \(120, 160, 3\)"),
        (np.zeros((160, 120), dtype=np.uint8), r"image 2 has shape \(160, 120\), image 0 has \(120, 160\)"),
        (np.zeros((0, 160), dtype=np.uint8), r"image 2 is empty, its shape is \(0, 160\)"),
    ],
)
def test_unusable_images_are_refused_by_number_and_change_nothing(image: np.ndarray, message: str) -> None:
    pattern = WhitePattern()
    for good in flashes(2, 0.5):
        pattern.add(good)
    before = pattern.result()
    with pytest.raises(ImageError, match=message):
        pattern.add(image)
    np.testing.assert_array_equal(pattern.result().image, before.image)
    assert pattern.result().images == 2


@pytest.mark.parametrize(("fill", "count"), [(0.5, 6), (0.5, 16), (0.7, 16)])
def test_the_simulated_camera_shows_white_where_dots_covered_the_plate(fill: float, count: int) -> None:
    shifts = (0, 9, 23, 40, 53, 70, 81, 97, 110, 124, 139, 151, 166, 180, 195, 211)
    plate = part_from_arrays("plate", *loft([rectangle_ring(0.4, 0.3, z) for z in (-0.01, 0.0)]), materials=("matte",))
    # the image is small and the slide coarse, so that dots measure as many pixels as on the full sensor
    slide = PatternSettings(columns=320, fill=fill, shifts_px=shifts)
    sensor = ActiveStereoSensor(rig_for(320, 256), [(plate, np.eye(4))], SensorSettings(pattern=slide))
    eye, _ = sensor._eyes(look_at((0.0, 0.0, 0.6), (0.0, 0.0, 0.0)), projector_on=True)
    true = np.mean([sensor._image(eye, (Projector.WHITE, k), 0.012) for k in range(8)], axis=0)
    found = white([sensor._image(eye, (Projector.DOTS, k), 0.012) for k in range(count)])
    lit = (true > 60) & (true < 250)
    assert lit.mean() > 0.1
    dark = found.dark.astype(float)
    uncovered = float(np.mean((found.image - dark < 0.9 * (true - dark))[lit]))
    assert found.uncovered_share is not None
    # it errs to the low side, and where next to nothing is uncovered by up to 2 %
    assert 0.35 * uncovered - 0.02 < found.uncovered_share < 1.1 * uncovered + 0.005
    assert (found.warning is not None) == (count == 6)
    error = (found.image - true)[lit]
    if count == 6:
        assert uncovered > UNCOVERED_LIMIT
        assert -30 < error.mean() < -3
    elif fill == 0.7:
        assert 0.0 < np.median(error) < 2.5
