"""The pictures of a scan: parts found, depth before and after, which view gave it, what forecasts were worth."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from sidelong.evaluation import reliability
from sidelong.evaluation.overlay import draw_overlay
from sidelong.types import FloatArray, Step
from sidelong_service.artifacts import Record

VIEW_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#8c564b")
"""Okabe and Ito's palette: told apart with any kind of colour vision."""
MARGIN = 0.08
"""Around the centres of the objects, as a share of the image width."""
MISSING_COLOUR = "#b00020"
REFERENCE_COLOUR = "#d9d9d9"


def draw(record: Record) -> dict[str, bytes]:
    """Return the pictures as PNG, by name; the reliability diagram where there is a view that was forecast.

    Raises
    ------
    ValueError
        The record has no reference view yet.
    """
    pictures = {"picture.png": draw_depths(record), "poses.png": draw_poses(record)}
    if record.reliability.forecasts:
        report = record.reliability.report()
        title = f"{record.setup.part}: forecasts of {report.views} views"
        pictures["reliability.png"] = reliability.draw(report, title)
    return pictures


def draw_poses(record: Record) -> bytes:
    """Return the mesh over the reference image as PNG, each object with its number and probability.

    Raises
    ------
    ValueError
        The record has no reference view yet.
    """
    if record.first is None or record.last is None:
        raise ValueError("the record has no reference view yet")
    image = record.image if record.image is not None else record.first.frame.left
    objects = record.last.objects
    sure = (item.hypotheses[0].probability for item in objects)
    names = [str(index) if p > 0.995 else f"{index}: {p:.0%}" for index, p in enumerate(sure)]
    return draw_overlay(image, record.part, record.camera, objects, names)


def draw_depths(record: Record) -> bytes:
    """Return the picture of the depth as PNG: image with the missing mask, depth before and after, pixels by view.

    Raises
    ------
    ValueError
        The record has no reference view yet.
    """
    from matplotlib.figure import Figure

    first, last = record.first, record.last
    if first is None or last is None:
        raise ValueError("the record has no reference view yet")
    rows, columns = window = _window(record, last)
    aspect = (rows.stop - rows.start) / (columns.stop - columns.start)
    figure: Any = Figure(figsize=(13.0, 2 * (4.7 * aspect + 0.4) + 1.0), layout="compressed")
    axes = figure.subplots(2, 2)
    figure.suptitle(_headline(record, last))
    _draw_missing(axes[0, 0], record, first, window)
    _draw_depths(figure, (axes[0, 1], axes[1, 0]), (first, last), window)
    _draw_sources(axes[1, 1], record, last)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[], xlim=(columns.start - 0.5, columns.stop - 0.5))
        axis.set_ylim(rows.stop - 0.5, rows.start - 0.5)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return buffer.getvalue()


def _headline(record: Record, last: Step) -> str:
    ending = f"ended: {last.stop}" if last.stop is not None else "ended early"
    return (
        f"{record.setup.part}: {last.recovered_px} of {last.missing_px} missing pixels on the parts recovered "
        f"({last.completeness:.0%}) with {last.index} further views, {ending}"
    )


def _window(record: Record, step: Step) -> tuple[slice, slice]:
    """Return rows and columns around the detected objects, the whole image where there are none."""
    height, width = step.depth_m.shape
    if not step.objects:
        return slice(0, height), slice(0, width)
    centres = np.array([thing.hypotheses[0].camera_T_object[:3, 3] for thing in step.objects])
    u, v = record.camera.project(centres).T
    return _span(v, height, MARGIN * width), _span(u, width, MARGIN * width)


def _span(centres_px: FloatArray, size_px: int, margin_px: float) -> slice:
    return slice(max(0, int(centres_px.min() - margin_px)), min(size_px, int(centres_px.max() + margin_px) + 1))


def _draw_missing(axis: Any, record: Record, first: Step, window: tuple[slice, slice]) -> None:
    image = record.image if record.image is not None else first.frame.left
    axis.imshow(image, cmap="gray", vmin=0, vmax=max(1.0, float(np.percentile(image[window], 99.5))))
    axis.imshow(_tint(np.isnan(first.depth_m), MISSING_COLOUR, 0.55))
    axis.set_title(f"reference view {first.view.name}: no depth in red")


def _draw_depths(figure: Any, axes: tuple[Any, Any], steps: tuple[Step, Step], window: tuple[slice, slice]) -> None:
    """Draw both depth maps on one scale, from the 1st to the 99th percentile of the depths in the window."""
    seen = steps[1].depth_m[window]
    near, far = np.percentile(seen[np.isfinite(seen)], (1, 99)) if np.isfinite(seen).any() else (0.0, 1.0)
    for axis, step, title in zip(axes, steps, ("depth before", "depth after"), strict=True):
        axis.set_facecolor("black")
        drawn = axis.imshow(step.depth_m * 1e3, cmap="viridis", vmin=near * 1e3, vmax=far * 1e3, interpolation="none")
        figure.colorbar(drawn, ax=axis, label="depth (mm)", shrink=0.8)
        axis.set_title(f"{title}: {np.isfinite(step.depth_m[window]).mean():.1%} of these pixels")


def _draw_sources(axis: Any, record: Record, last: Step) -> None:
    from matplotlib.patches import Patch

    axis.set_facecolor("black")
    axis.imshow(_tint(last.source == 0, REFERENCE_COLOUR, 1.0), interpolation="none")
    legend: list[Any] = [Patch(color=REFERENCE_COLOUR, label=f"{record.views[0].view} (reference)")]
    for report in record.views[1:]:
        colour = VIEW_COLOURS[(report.index - 1) % len(VIEW_COLOURS)]
        axis.imshow(_tint(last.source == report.index, colour, 1.0), interpolation="none")
        gains = f"expected {report.predicted_gain_px:.0f}, measured {report.measured_gain_px:.0f} px"
        legend.append(Patch(color=colour, label=f"{report.index}: {report.view}, {gains}"))
    legend.append(Patch(color="black", label="still missing"))
    axis.legend(handles=legend, loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=2, fontsize="small")
    axis.set_title("which view gave the depth")


def _tint(mask: Any, colour: str, alpha: float) -> FloatArray:
    """Return an RGBA layer (H, W, 4) that shows a colour where the mask holds."""
    from matplotlib.colors import to_rgb

    layer = np.zeros((*mask.shape, 4))
    layer[mask] = (*to_rgb(colour), alpha)
    return layer
