"""Strategies compared on a recorded scene: which cases are run, what the rows say, and the command itself."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sidelong.errors import DatasetError, UnknownNameError
from sidelong.evaluation.cases import Case, cases_of, truth_in
from sidelong.evaluation.compare import Row, Run
from sidelong.planning.selection import StrategyName
from sidelong.recipe import PlanningSettings, Recipe
from sidelong.recorded.dataset import Dataset
from sidelong_service.comparison import Comparison

ROBI = Path(__file__).parents[1] / "data" / "robi"
OBJECT, SCENE = "Tube_fitting", "Tube_fitting/Scene_1"
NAMES = ("view_0", "view_4", "view_8", "view_10", "view_12", "view_16")
NBV, RANDOM, FAR = StrategyName.NBV, StrategyName.RANDOM, StrategyName.MAX_DISTANCE
CAPTURE_S, MOVE_S = 0.7, 3.0
"""What a capture and a move are said to cost on a real cell."""

# --- which cases ---


@pytest.fixture
def lists(tmp_path: Path) -> Dataset:
    """Two objects, one of them with two scenes; a view of the second is called as a position could be."""
    for scene, names in (("Nut/Scene_1", "a b c"), ("Bolt/Scene_2", "x y"), ("Bolt/Scene_10", "1 z y")):
        folder = tmp_path / scene / "Ensenso"
        (folder / "Depth").mkdir(parents=True)
        for name in names.split():
            (folder / f"Depth/DEPTH_{name}.json").write_text(json.dumps({"cam_pose": np.eye(4).tolist()}))
        (folder / "list.txt").write_text("\n".join(names.split()))
    return Dataset(tmp_path)


def short(cases: Sequence[Case]) -> list[str]:
    return [f"{case.object} {case.scene} {case.reference}" for case in cases]


def test_without_a_choice_all_views_of_all_scenes_are_cases(lists: Dataset) -> None:
    assert short(cases_of(lists, None, None, None)) == [
        "Bolt 2 x", "Bolt 2 y", "Bolt 10 1", "Bolt 10 z", "Bolt 10 y", "Nut 1 a", "Nut 1 b", "Nut 1 c"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("object_name", "scene", "references", "expected"),
    [
        ("Nut", None, None, ["Nut 1 a", "Nut 1 b", "Nut 1 c"]),
        ("Bolt", 10, None, ["Bolt 10 1", "Bolt 10 z", "Bolt 10 y"]),
        ("Nut", 1, ["0", "2"], ["Nut 1 a", "Nut 1 c"]),
        ("Nut", 1, ["c", "1"], ["Nut 1 c", "Nut 1 b"]),
        ("Nut", 1, ["a", "0", "a"], ["Nut 1 a"]),
        ("Bolt", None, ["y"], ["Bolt 2 y", "Bolt 10 y"]),
        ("Bolt", 10, ["1"], ["Bolt 10 1"]),  # a name goes before a position
        ("Bolt", 2, ["1"], ["Bolt 2 y"]),
        ("Nut", 1, [], []),
    ],
)
def test_cases_are_chosen_by_object_scene_position_and_name(
    lists: Dataset, object_name: str, scene: int | None, references: list[str] | None, expected: list[str]
) -> None:
    assert short(cases_of(lists, object_name, scene, references)) == expected


@pytest.mark.parametrize(
    ("object_name", "scene", "references", "message"),
    [
        ("Gear", None, None, "object 'Gear' is unknown, known are Bolt, Nut$"),
        ("Bolt", 1, None, r"Bolt: scene 1 is unknown, known are 2, 10$"),
        (None, 1, None, "Bolt: scene 1 is unknown"),
        ("Nut", 1, ["0", "3"], r"Scene_1: reference 3 is out of range 0\.\.2$"),
        ("Nut", 1, ["d"], "Scene_1: view 'd' is unknown, known are a, b, c$"),
        ("Nut", 1, ["-1"], "Scene_1: view '-1' is unknown, known are a, b, c$"),
        ("Bolt", None, ["x"], "Scene_10: view 'x' is unknown, known are 1, z, y$"),
    ],
)
def test_what_the_data_set_has_not_is_refused_with_what_it_has(
    lists: Dataset, object_name: str | None, scene: int | None, references: list[str] | None, message: str
) -> None:
    with pytest.raises(UnknownNameError, match=message):
        cases_of(lists, object_name, scene, references)


def test_a_folder_without_scenes_is_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"has no <Object>/Scene_<k>/"):
        cases_of(Dataset(tmp_path), None, None, None)


def test_a_scene_without_its_list_is_refused(lists: Dataset) -> None:
    (lists.root / "Nut/Scene_1/Ensenso/list.txt").unlink()
    with pytest.raises(DatasetError, match=r"Nut/Scene_1/Ensenso/list\.txt: the list of views is missing"):
        cases_of(lists, None, None, None)


# --- the rows ---


def refuse(case: Case, why: str) -> None:
    raise AssertionError(f"{case} was left out: {why}")


def compared(
    runs: Sequence[Run],
    views: int,
    references: Sequence[str] = ("0",),
    root: Path = ROBI,
    skipped: Callable[[Case, str], None] = refuse,
) -> list[Row]:
    dataset = Dataset(root)
    recipe = Recipe(planning=PlanningSettings(max_views=views))
    cases = cases_of(dataset, OBJECT, 1, references)
    comparison = Comparison(dataset, cases, tuple(runs), recipe, cache_dir=Path("unused"), true_poses=True)
    return list(comparison.rows(skipped))


@pytest.fixture(scope="module")
def exhausted() -> list[Row]:
    """Six views asked of five candidates, by each strategy; Random with seeds 0, 1, 2 and 0 again."""
    seeds = [Run(RANDOM, seed) for seed in (0, 1, 2, 0)]
    return compared([Run(NBV), *seeds, Run(FAR)], views=6)


@pytest.fixture(scope="module")
def runs(exhausted: list[Row]) -> list[list[Row]]:
    return [exhausted[start : start + 6] for start in range(0, len(exhausted), 6)]


def test_each_run_gives_a_row_for_each_view_in_the_order_asked_for(runs: list[list[Row]]) -> None:
    expected = [(NBV, 0), (RANDOM, 0), (RANDOM, 1), (RANDOM, 2), (RANDOM, 0), (FAR, 0)]
    assert [{(row.strategy, row.seed) for row in run} for run in runs] == [{each} for each in expected]
    assert all([row.views_added for row in run] == [1, 2, 3, 4, 5, 6] for run in runs)
    assert {(row.object, row.scene, row.reference) for run in runs for row in run} == {(OBJECT, 1, "view_0")}


def test_a_run_takes_each_candidate_once_and_never_the_reference(runs: list[list[Row]]) -> None:
    for run in runs:
        assert sorted(str(row.view) for row in run[:5]) == sorted(NAMES[1:])


def test_missing_pixels_are_those_of_the_truth_whatever_the_run(runs: list[list[Row]]) -> None:
    dataset = Dataset(ROBI)
    scene = dataset.scene(OBJECT, 1)
    truth = truth_in(scene, scene.view("view_0"), dataset.part(OBJECT))
    assert {row.missing_px for run in runs for row in run} == {int(truth.missing.sum())}
    # on the parts without depth, most of what is missing there has a known truth
    assert 1000 < truth.missing.sum() < truth.on_parts.sum()
    assert truth.completeness(scene.depth_m("view_0")) == 0.0


def test_views_complete_the_depth_and_measure_what_was_missing(runs: list[list[Row]]) -> None:
    """A completed pixel stays completed, so no view measures less than nothing; its depth may still change later."""
    for run in runs:
        assert all(row.measured_gain_px >= 0 for row in run)
        assert 0.1 < run[0].completeness < run[1].completeness < run[4].completeness < 1.0
        # what the planner counts needs no known truth, so it may be more, but is most of it
        recovered_px = run[4].completeness * run[4].missing_px
        assert sum(row.measured_gain_px for row in run) > recovered_px


def test_all_candidates_together_give_the_same_in_any_order(runs: list[list[Row]]) -> None:
    ends = [run[4].completeness for run in runs]
    assert np.ptp(ends) < 0.005
    assert np.mean(ends) > 0.6


def test_a_run_that_has_no_candidate_left_keeps_its_last_completeness(runs: list[list[Row]]) -> None:
    for run in runs:
        last, kept = run[4], run[5]
        assert last.view is not None
        expected = {"views_added": 6, "view": None, "predicted_gain_px": 0.0, "measured_gain_px": 0.0}
        assert kept.model_dump() == last.model_dump() | expected


def outcome(run: Sequence[Row]) -> list[dict[str, Any]]:
    return [row.model_dump(exclude={"compute_s", "cell_s", "stage_s", "seed"}) for row in run]


def test_random_repeats_itself_with_the_same_seed_and_not_with_others(runs: list[list[Row]]) -> None:
    assert outcome(runs[1]) == outcome(runs[4])
    assert len({tuple(row.view for row in run) for run in runs[1:4]}) > 1


def test_next_best_view_takes_the_candidate_that_promises_most_first(runs: list[list[Row]]) -> None:
    nbv = runs[0]
    assert all(row.predicted_gain_px > 0 for row in nbv[:5])
    # all runs start from the same reference, so the promise of a view is the same in each
    first = {run[0].view: run[0].predicted_gain_px for run in runs}
    assert len(first) > 1
    assert nbv[0].predicted_gain_px == max(first.values())


def test_maximum_distance_takes_the_view_farthest_from_the_reference_first(runs: list[list[Row]]) -> None:
    eyes = {view.name: view.base_T_camera[:3, 3] for view in Dataset(ROBI).scene(OBJECT, 1).views()}
    away = {name: float(np.linalg.norm(eyes[name] - eyes["view_0"])) for name in NAMES}
    assert runs[5][0].view == max(away, key=lambda name: away[name])


def test_computing_adds_up_and_the_cell_adds_captures_and_moves(runs: list[list[Row]]) -> None:
    for run in runs:
        for before, row in pairwise(run[:5]):
            assert row.compute_s > before.compute_s
            assert all(row.stage_s[stage] >= seconds for stage, seconds in before.stage_s.items())
        for row in run[:5]:
            assert set(row.stage_s) >= {"move", "capture", "fuse"}
            computed = {stage: row.stage_s.get(stage, 0.0) for stage in ("detect", "refine", "score", "fuse")}
            assert row.compute_s == pytest.approx(sum(computed.values()))
            assert computed["fuse"] > 0
            stated_s = (row.views_added + 1) * CAPTURE_S + row.views_added * MOVE_S
            assert row.cell_s == pytest.approx(row.compute_s + stated_s)


def test_two_views_are_the_first_two_of_six(runs: list[list[Row]]) -> None:
    """One reference, two views; scores and gains depend on nothing that comes later."""
    rows = compared([Run(NBV)], views=2)
    assert outcome(rows) == outcome(runs[0][:2])


def test_a_reference_without_true_depth_is_left_out_and_said_so(tmp_path: Path) -> None:
    root = tmp_path / "robi"
    shutil.copytree(ROBI, root, copy_function=shutil.copyfile)
    for suffix in (".png", ".json"):
        (root / SCENE / f"GT_Depth/DEPTH_view_4{suffix}").unlink()
    told: list[tuple[Case, str]] = []
    rows = compared([Run(FAR)], 1, ["1", "2"], root, lambda case, why: told.append((case, why)))
    assert [row.reference for row in rows] == ["view_8"]
    ((case, why),) = told
    assert case == Case(OBJECT, 1, "view_4")
    assert why == f"{root / SCENE}: view view_4 has no true depth"


# --- the command ---

KEYS = {
    "object", "scene", "reference", "strategy", "refined", "seed", "views_added", "view", "completeness",
    "poses", "depth", "missing_px", "predicted_gain_px", "measured_gain_px", "compute_s", "cell_s", "stage_s",
}  # fmt: skip


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("SIDELONG_", "FORCE_"))}
    return subprocess.run(
        [sys.executable, "-m", "sidelong_service", "compare", *arguments],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


def test_the_command_writes_rows_and_a_plot(tmp_path: Path) -> None:
    asked = "--true-poses --references 0 --views 1 --seeds 2 --json rows.json --plot plot.png"
    done = command(tmp_path, str(ROBI), *asked.split())
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert [(row["strategy"], row["seed"]) for row in rows] == [
        ("nbv", 0), ("random", 0), ("random", 1), ("max_distance", 0)
    ]  # fmt: skip
    for row in rows:
        assert set(row) == KEYS
        assert (row["object"], row["scene"], row["reference"], row["views_added"]) == (OBJECT, 1, "view_0", 1)
        assert 0 < row["completeness"] < 1
    with Image.open(tmp_path / "plot.png") as plot:
        assert plot.format == "PNG"
        plot.load()
    assert "nbv" in done.stdout
    assert "rows.json" in done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plot.png", "rows.json"]


def test_the_command_judges_poses_as_detected_and_refined(tmp_path: Path) -> None:
    """Depth brings the poses of the found parts nearer to the truth, and finds no fewer."""
    asked = "--poses --refinement both --references 0 --views 1 --strategies nbv --json rows.json"
    done = command(tmp_path, str(ROBI), *asked.split())
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert [(row["refined"], row["views_added"]) for row in rows] == [(False, 0), (False, 1), (True, 0), (True, 1)]
    as_detected, _, alone, refined = (row["poses"] for row in rows)
    assert as_detected == rows[1]["poses"]
    assert as_detected["detected"] == refined["detected"] >= 8
    assert as_detected["visible"] >= refined["found"] >= as_detected["found"] >= 5
    assert refined["correct_symmetric"] >= 8
    assert refined["add_symmetric_m"] < min(alone["add_symmetric_m"], as_detected["add_symmetric_m"])
    assert refined["add_symmetric_m"] < 1e-3  # one disparity is 6.6 mm on these halved images
    for label in ("single view unrefined", "single view ", "nbv unrefined", "nbv "):
        assert label in done.stdout


def test_the_command_judges_the_errors_of_the_depth_beside_the_sensor_s_own(tmp_path: Path) -> None:
    asked = "--true-poses --depth --references 0 --views 2 --strategies nbv --json rows.json"
    done = command(tmp_path, str(ROBI), *asked.split())
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert [row["views_added"] for row in rows] == [0, 1, 2]
    assert (rows[0]["completeness"], rows[0]["depth"]["completed"]["pixels"]) == (0.0, 0)
    for row in rows:
        assert row["poses"] is None
        depth = row["depth"]
        for name in ("completed", "measured"):
            assert depth[f"{name}_on_parts"]["pixels"] <= depth[name]["pixels"]
        # on these halved images one disparity is 6.6 mm, and half a millimetre the median of what is measured there
        assert 0 < depth["measured"]["median_m"] < depth["measured"]["p95_m"] < 2e-3
    first, last = rows[1]["depth"], rows[2]["depth"]
    assert 0 < first["completed_on_parts"]["pixels"] < last["completed_on_parts"]["pixels"]
    assert 0 < last["completed"]["median_m"] < 1e-3
    assert 0 <= last["completed"]["beyond"] < 0.1
    # recovered are those of the completed on parts, doubtful ones too, that are not beyond 2 mm
    recovered_px = rows[2]["completeness"] * rows[2]["missing_px"]
    assert recovered_px >= last["completed_on_parts"]["pixels"] * (1 - last["completed_on_parts"]["beyond"]) - 0.5
    for words in ("errors of the depth on the parts", "wherever the truth is known", "single view", "sens."):
        assert words in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nowhere",), "nowhere: no such data set folder"),
        ((str(ROBI), "--strategies", "nbv,best"), "--strategies: best given, known are nbv, random, max_distance"),
        ((str(ROBI), "--refinement", "some"), "--refinement: 'some' given, known are on, off, both"),
        ((str(ROBI), "--object", "Gear"), "object 'Gear' is unknown, known are Tube_fitting"),
        ((str(ROBI), "--references", "6"), "reference 6 is out of range 0..5"),
    ],
)
def test_a_wrong_argument_is_one_line_on_the_error_stream(
    tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    done = command(tmp_path, *arguments, "--plot", "plot.png")
    assert done.returncode == 1
    assert done.stderr.startswith("error")
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    assert done.stdout == ""
    assert not list(tmp_path.iterdir())
