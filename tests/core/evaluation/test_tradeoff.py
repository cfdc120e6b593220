"""Rows of a comparison brought to one point for each strategy and number of views, and drawn."""

from __future__ import annotations

import io
import random
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sidelong.evaluation.compare import Row
from sidelong.evaluation.depth_score import DepthErrors, DepthScore
from sidelong.evaluation.pose_score import PoseScore
from sidelong.evaluation.tradeoff import Point, draw, summarise, summarise_depth, summarise_poses
from sidelong.planning.selection import StrategyName

NBV, RANDOM, FAR = StrategyName.NBV, StrategyName.RANDOM, StrategyName.MAX_DISTANCE


def row(
    strategy: StrategyName, reference: str, completeness: float, seed: int = 0, views_added: int = 1, scene: int = 1
) -> Row:
    """A run whose times are in step with its completeness, so that hand-computed means serve for both."""
    return Row(
        object="gear",
        scene=scene,
        reference=reference,
        strategy=strategy,
        seed=seed,
        views_added=views_added,
        view="v",
        completeness=completeness,
        missing_px=1000,
        predicted_gain_px=0.0,
        measured_gain_px=0.0,
        compute_s=10 * completeness,
        cell_s=100 * completeness,
        stage_s={},
    )


def test_seeds_are_averaged_within_a_reference_first() -> None:
    """Three seeds at a and one at b: (mean(0.2, 0.4, 0.6) + 0.8) / 2 = 0.6, where the mean of all rows is 0.5."""
    rows = [row(RANDOM, "a", value, seed) for seed, value in enumerate((0.2, 0.4, 0.6))] + [row(RANDOM, "b", 0.8)]
    (point,) = summarise(rows)
    assert point.completeness == pytest.approx(0.6)
    assert point.compute_s == pytest.approx(6.0)
    assert point.cell_s == pytest.approx(60.0)
    assert point.references == 2


def test_the_worst_is_the_lowest_reference_and_not_the_lowest_seed() -> None:
    rows = [row(RANDOM, "a", value, seed) for seed, value in enumerate((0.1, 0.7))] + [row(RANDOM, "b", 0.8)]
    (point,) = summarise(rows)
    assert point.worst == pytest.approx(0.4)


def test_the_same_name_in_two_scenes_is_two_references() -> None:
    rows = [row(NBV, "a", 0.2), row(NBV, "a", 0.4, scene=2), row(NBV, "a", 0.6, scene=2, seed=1)]
    (point,) = summarise(rows)
    assert point.references == 2
    assert point.completeness == pytest.approx((0.2 + 0.5) / 2)
    assert point.worst == pytest.approx(0.2)


def test_strategies_stand_in_the_order_of_their_first_row_and_views_are_counted_up() -> None:
    rows = [row(FAR, "a", 0.3, views_added=2), row(NBV, "a", 0.9, views_added=2), row(RANDOM, "a", 0.1)]
    rows += [row(NBV, "a", 0.5), row(FAR, "a", 0.2), row(NBV, "a", 0.9, views_added=8)]
    points = summarise(rows)
    assert [(point.strategy, point.views_added) for point in points] == [
        (FAR, 1), (FAR, 2), (NBV, 1), (NBV, 2), (NBV, 8), (RANDOM, 1)
    ]  # fmt: skip
    assert [point.completeness for point in points] == pytest.approx([0.2, 0.3, 0.5, 0.9, 0.9, 0.1])


def test_the_order_of_the_rows_of_a_strategy_does_not_matter() -> None:
    rows = [row(NBV, name, value, views_added=n) for n in (1, 2) for name, value in (("a", 0.1 * n), ("b", 0.3 * n))]
    shuffled = random.Random(3).sample(rows, len(rows))
    assert shuffled != rows
    for one, other in zip(summarise(rows), summarise(shuffled), strict=True):
        assert (one.strategy, one.views_added, one.references) == (other.strategy, other.views_added, other.references)
        assert (one.completeness, one.worst) == pytest.approx((other.completeness, other.worst))


def test_one_row_is_its_own_point() -> None:
    assert summarise([row(NBV, "a", 0.25, views_added=3)]) == [Point(NBV, True, 3, 0.25, 0.25, 2.5, 25.0, 1)]


def judged(strategy: StrategyName, views_added: int, refined: bool, **score: Any) -> Row:
    """A row whose poses were judged: of four detected objects so many correct, of five visible parts so many found."""
    nothing = dict.fromkeys(("add_m", "add_symmetric_m", "adi_m", "mssd_m", "mspd_px", "rotation_rad"))
    counts = {"detected": 4, "visible": 5, "found": 0, "correct": 0, "correct_symmetric": 0}
    poses = PoseScore.model_validate({**nothing, **counts, **score})
    return row(strategy, "a", 0.5, views_added=views_added).model_copy(update={"refined": refined, "poses": poses})


def test_poses_are_counted_over_all_objects_and_errors_weighted_by_how_many_are_correct() -> None:
    """3 of 4 and 1 of 4 are half of all; 1 mm of three and 5 mm of one are 2 mm."""
    many = judged(NBV, 1, True, correct=3, add_m=1e-3, correct_symmetric=4, add_symmetric_m=2e-3, found=3, mssd_m=3e-3)
    few = judged(NBV, 1, True, correct=1, add_m=5e-3, correct_symmetric=0, found=1)
    (point,) = summarise_poses([many, few])
    assert (point.rate, point.rate_symmetric, point.recall) == (0.5, 0.5, 0.4)
    assert point.add_m == pytest.approx(2e-3)
    assert (point.add_symmetric_m, point.mssd_m) == pytest.approx((2e-3, 3e-3))
    assert point.label == "nbv"


def test_the_reference_view_alone_is_listed_once_for_refined_and_unrefined_poses_each() -> None:
    rows = [judged(s, n, refined) for s in (NBV, FAR) for refined in (False, True) for n in (0, 1)]
    assert [(point.label, point.views_added) for point in summarise_poses(rows)] == [
        ("single view unrefined", 0), ("nbv unrefined", 1), ("single view", 0), ("nbv", 1),
        ("max_distance unrefined", 1), ("max_distance", 1),
    ]  # fmt: skip
    assert [(point.strategy, point.views_added) for point in summarise(rows)] == [
        (NBV, 1),
        (NBV, 1),
        (FAR, 1),
        (FAR, 1),
    ]


def test_where_nothing_was_detected_or_judged_there_is_no_number() -> None:
    (point,) = summarise_poses([judged(NBV, 1, True, detected=0, visible=0)])
    assert all(np.isnan([point.rate, point.add_m, point.rate_symmetric, point.mssd_m, point.recall]))
    assert summarise_poses([row(NBV, "a", 0.5)]) == []


def with_errors(strategy: StrategyName, views_added: int, pixels: int, median_m: float | None) -> Row:
    """A row whose depth was judged: so many completed pixels, a tenth of them on parts, half as many measured."""

    def errors(count: int) -> DepthErrors:
        return (
            DepthErrors(pixels=count) if median_m is None else DepthErrors(pixels=count, median_m=median_m, beyond=0.1)
        )

    depth = DepthScore(
        completed_on_parts=errors(pixels // 10), completed=errors(pixels),
        measured_on_parts=errors(pixels // 20), measured=errors(pixels // 2),
    )  # fmt: skip
    return row(strategy, "a", 0.5, views_added=views_added).model_copy(update={"depth": depth})


def test_errors_of_depth_are_weighted_by_pixels_on_parts_and_everywhere() -> None:
    """1 mm of 3000 pixels and 5 mm of 1000 are 2 mm; 2000 pixels is their mean number."""
    on_parts, everywhere = summarise_depth([with_errors(NBV, 1, 3000, 1e-3), with_errors(NBV, 1, 1000, 5e-3)])
    assert (on_parts.label, on_parts.views_added, on_parts.on_parts, everywhere.on_parts) == ("nbv", 1, True, False)
    assert (everywhere.completed.pixels, everywhere.measured.pixels) == (2000, 1000)
    assert (on_parts.completed.pixels, on_parts.measured.pixels) == (200, 100)
    for errors in (on_parts.completed, on_parts.measured, everywhere.completed, everywhere.measured):
        assert errors.median_m == pytest.approx(2e-3)
        assert errors.beyond == pytest.approx(0.1)
        assert errors.normalised_std is None


def test_rows_without_completed_pixels_have_no_say_in_the_errors() -> None:
    _, everywhere = summarise_depth([with_errors(NBV, 1, 1000, 1e-3), with_errors(NBV, 1, 0, None)])
    assert (everywhere.completed.pixels, everywhere.completed.median_m) == (500, pytest.approx(1e-3))


def test_errors_at_the_reference_view_alone_are_listed_once_and_rows_not_judged_never() -> None:
    rows = [with_errors(s, n, 1000, 1e-3) for s in (NBV, FAR) for n in (0, 1)] + [row(RANDOM, "a", 0.5)]
    assert [(point.label, point.views_added) for point in summarise_depth(rows) if point.on_parts] == [
        ("single view", 0), ("nbv", 1), ("max_distance", 1)
    ]  # fmt: skip


def test_no_rows_give_no_points() -> None:
    assert summarise([]) == []
    assert summarise_depth([]) == []


def picture(points: list[Point], title: str = "gear") -> np.ndarray:
    png = draw(points, title)
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image.convert("RGB"), dtype=int)


def test_the_plot_is_a_png_with_a_curve_for_each_strategy_in_three_panels() -> None:
    """Every further strategy brings its own colour into the left, the middle and the right third."""
    points = [
        Point(strategy, True, n, 0.1 * n + 0.2 * at, 0.1, 0.3 * n, 4.0 * n, 2)
        for at, strategy in enumerate((NBV, RANDOM, FAR))
        for n in (1, 2, 3)
    ]
    colours = [(31, 119, 180), (255, 127, 14), (44, 160, 44)]  # first of matplotlib's cycle
    drawn = picture(points)
    assert drawn.shape[1] > 2 * drawn.shape[0] > 400
    for count in (1, 2, 3):
        panels = np.array_split(picture(points[: 3 * count]), 3, axis=1)
        for panel in panels:
            present = [bool((np.abs(panel - colour).max(axis=-1) <= 2).any()) for colour in colours]
            assert present == [at < count for at in range(3)]


def test_the_plot_shows_the_values_and_the_title() -> None:
    low, high = ([Point(NBV, True, n, share * n, 0.1, 0.3 * n, 4.0 * n, 2) for n in (1, 2)] for share in (0.1, 0.3))
    assert not np.array_equal(picture(low), picture(high))
    assert not np.array_equal(picture(low), picture(low, "another title"))
    np.testing.assert_array_equal(picture(low), picture(low))
