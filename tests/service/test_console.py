"""What an operator reads on the command line."""

from __future__ import annotations

import io

import numpy as np
import pytest
from rich.console import Console
from rich.table import Table
from scan_steps import SHAPE, fused, step

from sidelong.evaluation.depth_score import DepthErrors
from sidelong.evaluation.tradeoff import DepthPoint
from sidelong.types import FusedView, PixelState
from sidelong_service.console import ScanProgress, depth_table, told, view_table
from sidelong_service.models import ViewReport

MEASURED = np.full(SHAPE, PixelState.MEASURED, dtype=np.uint8)


def view(index: int = 1, of: FusedView | None = None) -> ViewReport:
    return ViewReport.of(step(MEASURED, index, of), np.eye(4))


def printed(table: Table) -> list[str]:
    screen = io.StringIO()
    Console(file=screen, width=80).print(table)
    return screen.getvalue().splitlines()


def test_a_view_tells_its_gain_and_how_far_it_was_moved() -> None:
    assert told(view(0)) == "0 objects, 4000 px without depth on them"
    assert told(view(1, fused())) == "gain 1000 px, 25.0% complete, moved by 0.21 mm, 0.057 degrees"
    assert told(view(1, fused(contradicted_px=7))).endswith("0.057 degrees, 7 px contradicted")


def test_a_refused_view_tells_why_as_it_comes_and_stands_in_the_table() -> None:
    why = "contradicts the reference: 41% of what both saw agrees, limit 90%"
    refused = view(1, fused(refused=why))
    assert told(refused) == f"refused: {why}"
    screen = io.StringIO()
    with ScanProgress(Console(file=screen, width=80)) as progress:
        progress.show("view", refused.model_dump())
    assert f"view 1  view_1: refused: {why}" in screen.getvalue()
    lines = printed(view_table([view(0), refused, view(2, fused())]))
    assert [("refused" in line) for line in lines if "view_" in line] == [False, True, False]


def test_a_view_of_an_older_version_is_shown_without_what_it_does_not_know() -> None:
    older = ViewReport.model_validate(view(1).model_dump(exclude={"fused", "state_px"}))
    assert (older.fused, older.state_px, older.refused) == (None, {}, None)
    assert told(older) == "gain 1000 px, 25.0% complete"


def test_a_report_counts_every_state_and_puts_the_view_into_the_base_frame() -> None:
    state = MEASURED.copy()
    state[0, :9], state[1, :4] = PixelState.COMPLETED, PixelState.CONTRADICTED
    base_T_reference = np.diag([1.0, -1.0, -1.0, 1.0])
    base_T_reference[:3, 3] = 0.5, 0.0, 0.7
    report = ViewReport.of(step(state, 1, fused(agreement=float("nan"))), base_T_reference)
    assert report.state_px == {
        "missing": 0, "measured": state.size - 13, "completed": 9, "contradicted": 4, "doubtful": 0, "modelled": 0
    }  # fmt: skip
    assert report.fused is not None
    assert [row[3] for row in report.fused.base_T_camera] == [0.6, 0.0, 0.7, 1.0]
    assert report.fused.agreement is None
    assert ViewReport.model_validate_json(report.model_dump_json()) == report


@pytest.mark.parametrize("on_parts", [True, False])
def test_the_table_of_the_depth_is_in_millimetres_and_percent_and_fits_a_screen(on_parts: bool) -> None:
    measured = DepthErrors(pixels=900_000, median_m=0.2e-3, p95_m=0.8e-3, beyond=0.01, recovered_p95_m=0.7e-3)
    filled = DepthErrors(
        pixels=123_456, median_m=0.31e-3, p95_m=11.66e-3, beyond=0.128, recovered_p95_m=1.25e-3, normalised_std=1.04,
        coverage=0.953,
    )  # fmt: skip
    points = [
        DepthPoint("single view", 0, on_parts, DepthErrors(pixels=0), measured),
        DepthPoint("max_distance", 3, on_parts, filled, measured),
        DepthPoint("max_distance", 3, not on_parts, measured, measured),
    ]
    lines = printed(depth_table(points, on_parts=on_parts))
    assert ("on the parts" if on_parts else "wherever the truth is known") in lines[0]
    alone, far = (line.split() for line in lines if "single" in line or "max_distance" in line)
    assert " ".join(alone) == "single view 0 0 0.20 0.80"
    assert " ".join(far) == "max_distance 3 123456 0.31 11.66 12.8 1.25 1.04 95.3 0.20 0.80"
