"""What the command line shows of a scan: progress while it runs, then a table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table

from sidelong_service.models import EventKind, ViewReport

if TYPE_CHECKING:  # scipy and what needs it wait for the commands that use them
    from sidelong.evaluation.depth_score import DepthErrors
    from sidelong.evaluation.tradeoff import DepthPoint, Point, PosePoint

STAGES = ("move", "capture", "detect", "refine", "score", "fuse")


class _Bars:
    """Bars that are there while work is done. A context manager."""

    def __init__(self, console: Console, *columns: ProgressColumn) -> None:
        self._progress = Progress(*columns, TimeElapsedColumn(), console=console, transient=True)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def note(self, text: str) -> None:
        """Print a line above the bars."""
        self._progress.console.print(text, highlight=False, markup=False, soft_wrap=True)


class ScanProgress(_Bars):
    """Shows the events of a scan as they come. A context manager."""

    def __init__(self, console: Console) -> None:
        state = TextColumn("{task.fields[state]}")
        super().__init__(console, SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=30), state)
        self.views: list[ViewReport] = []
        self._phase: TaskID = self._progress.add_task("starting", total=None, state="")
        self._work: TaskID | None = None

    def show(self, kind: EventKind, data: Mapping[str, Any]) -> None:
        """Show an event."""
        match kind:
            case "phase":
                self._progress.update(self._phase, description=data["phase"])
            case "progress":
                self._show_work(data["work"], data["done"], data["total"])
            case "view":
                self._show_view(ViewReport.model_validate(data))
            case _:
                pass

    def _show_work(self, work: str, done: int, total: int) -> None:
        if self._work is None:
            self._work = self._progress.add_task(work, total=total, state="")
        self._progress.update(self._work, completed=done, state=f"{done} of {total}")
        if done >= total:
            self._progress.remove_task(self._work)
            self._work = None

    def _show_view(self, view: ViewReport) -> None:
        self.views.append(view)
        self._progress.update(self._phase, state=f"{view.completeness:.0%} complete")
        self.note(f"  view {view.index}  {view.view}: {told(view)}")


def told(view: ViewReport) -> str:
    """Return what a view gave in one line; of one that was refused, why."""
    if view.index == 0:
        return f"{view.objects} objects, {view.missing_px} px without depth on them"
    if view.refused is not None:
        return f"refused: {view.refused}"
    words = [f"gain {view.measured_gain_px:.0f} px", f"{view.completeness:.1%} complete"]
    fused = view.fused
    if fused is not None and fused.shared_points:
        words.append(f"moved by {fused.shift_m * 1e3:.2f} mm, {math.degrees(fused.turn_rad):.3f} degrees")
    if fused is not None and fused.contradicted_px:
        words.append(f"{fused.contradicted_px} px contradicted")
    return ", ".join(words)


def view_table(views: Sequence[ViewReport]) -> Table:
    """Return the table of a scan: view, gains, completeness, seconds of each stage."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 0), pad_edge=False)
    table.add_column("\nview")
    for name in ("expected\ngain px", "measured\ngain px", "\ncomplete", *(f"{stage}\ns" for stage in STAGES)):
        table.add_column(name, justify="right")
    for view in views:
        measured = f"{view.measured_gain_px:.0f}" if view.refused is None else "refused"
        gains = ("", "") if view.index == 0 else (f"{view.predicted_gain_px:.0f}", measured)
        seconds = [f"{view.stage_s[stage]:.2f}" if stage in view.stage_s else "" for stage in STAGES]
        table.add_row(f"{view.index} {view.view}", *gains, f"{view.completeness:.1%}", *seconds)
    return table


class CountedProgress(_Bars):
    """Shows how much of a counted work is done, and how much a preparation. A context manager."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, TextColumn("{task.description}"), BarColumn(bar_width=30), MofNCompleteColumn())
        self._tasks: dict[str, TaskID] = {}

    def show(self, work: str, done: int, total: int) -> None:
        """Show how far a work is; one that is done disappears."""
        if work not in self._tasks:
            self._tasks[work] = self._progress.add_task(work, total=total)
        self._progress.update(self._tasks[work], completed=done, total=total, visible=done < total)


def comparison_table(points: Sequence[Point]) -> Table:
    """Return the table of a comparison: strategies, completeness after each view, seconds."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("\nstrategy", no_wrap=True)
    for name in ("views\nadded", "complete\nmean", "complete\nlowest", "computing\ns", "cell\ns", "\nreferences"):
        table.add_column(name, justify="right")
    for point in points:
        table.add_row(
            point.label,
            str(point.views_added),
            f"{point.completeness:.1%}",
            f"{point.worst:.1%}",
            f"{point.compute_s:.2f}",
            f"{point.cell_s:.1f}",
            str(point.references),
        )
    return table


def pose_table(points: Sequence[PosePoint]) -> Table:
    """Return the table of the poses: the paper's rate and ADD, the same modulo symmetry, parts found, seconds."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("\nstrategy", no_wrap=True)
    headers = "views\nadded", "ADD ok\n%", "ADD\nmm", "mod sym.\n%", "ADD\nmm", "MSSD\nmm", "found\n%", "\ns"
    for name in headers:
        table.add_column(name, justify="right", no_wrap=True)
    for point in points:
        table.add_row(
            point.label,
            str(point.views_added),
            f"{100 * point.rate:.1f}",
            f"{point.add_m * 1e3:.2f}",
            f"{100 * point.rate_symmetric:.1f}",
            f"{point.add_symmetric_m * 1e3:.2f}",
            f"{point.mssd_m * 1e3:.2f}",
            f"{100 * point.recall:.1f}",
            f"{point.compute_s:.2f}",
        )
    return table


DEPTH_TABLE_WIDTH = 110


def depth_table(points: Sequence[DepthPoint], *, on_parts: bool) -> Table:
    """Return the table of the depth, on the parts or everywhere.

    Errors of filled pixels, the 95th percentile of the rest that is within 2 mm, whether sigma is honest, and the
    sensor's own where the reference view measured.
    """
    title = "errors of the depth on the parts" if on_parts else "errors of the depth wherever the truth is known"
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=title, title_justify="left")
    table.add_column("\nstrategy", no_wrap=True)
    errors = "med.\nmm", "95 %\nmm", ">2 mm\n%", "rest\n95 %"
    for name in ("\nviews", "filled\npx", *errors, "err/\nsig", "cov.\n%", "sens.\nmm", "95 %\nmm"):
        table.add_column(name, justify="right", no_wrap=True)
    for point in points:
        if point.on_parts == on_parts:
            numbers = *_errors(point.completed), *_millimetres(point.measured)
            table.add_row(point.label, str(point.views_added), *numbers)
    return table


def _errors(of: DepthErrors) -> tuple[str, ...]:
    sigma = _number(of.normalised_std, 1, 2), _number(of.coverage, 100, 1)
    return str(of.pixels), *_millimetres(of), _number(of.beyond, 100, 1), _number(of.recovered_p95_m, 1e3, 2), *sigma


def _millimetres(of: DepthErrors) -> tuple[str, ...]:
    return _number(of.median_m, 1e3, 2), _number(of.p95_m, 1e3, 2)


def _number(value: float | None, unit: float, digits: int) -> str:
    return "" if value is None else f"{value * unit:.{digits}f}"
