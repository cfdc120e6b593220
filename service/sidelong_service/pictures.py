"""The pictures of a scan: parts found, depth before and after with its uncertainty, which view gave it, what it rests
on, what forecasts were worth."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from sidelong.evaluation import reliability
from sidelong.evaluation.overlay import draw_overlay
from sidelong.types import BoolArray, FloatArray, PixelState, Step
from sidelong_service.artifacts import Record

VIEW_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#8c564b")
"""Okabe and Ito's palette: told apart with any kind of colour vision."""
MARGIN = 0.08
"""Around the centres of the objects, as a share of the image width."""
MISSING_COLOUR = "#b00020"
MISSING_ALPHA = 0.55
NOTHING_COLOUR = "#000000"
REFERENCE_COLOUR = "#d9d9d9"
STATE_COLOURS = {
    PixelState.MEASURED: REFERENCE_COLOUR,
    PixelState.COMPLETED: "#009e73",
    PixelState.MODELLED: "#56b4e9",
    PixelState.MISSING: NOTHING_COLOUR,
    PixelState.DOUBTFUL: "#f0e442",
    PixelState.CONTRADICTED: "#d50000",
}
"""In the order they are drawn."""
MARKS = (PixelState.DOUBTFUL, PixelState.CONTRADICTED)
"""States of few, scattered pixels: drawn one pixel larger, to be seen at all."""

SMALLEST_SIGMA_MM = 1e-3
TICKS = 5
PANEL_IN, GAP_IN, TITLE_IN, SCALE_IN, LINE_IN = 5.8, 0.15, 0.4, 0.6, 0.2
"""Sizes of the picture of the depth, inches: width of a panel, and what is around it."""
STATE_LINES = len(STATE_COLOURS)

Axis = Any
Window = tuple[slice, slice]
Layer = tuple[BoolArray, str, str]
"""A mask (H, W), its colour, and what it means."""


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
    """Return the picture of the depth as PNG: what was missing, depth before and after, its uncertainty, and for each
    pixel which view gave it and what it rests on.

    Raises
    ------
    ValueError
        The record has no reference view yet.
    """
    from matplotlib.figure import Figure

    first, last = record.first, record.last
    if first is None or last is None:
        raise ValueError("the record has no reference view yet")
    window = _window(record, last)
    rows, columns = last.depth.state[window].shape
    figure: Any = Figure(dpi=100)
    axes = _panels(figure, rows / columns, len(record.views))
    figure.suptitle(_headline(record, last))
    _draw_missing(axes[0, 0], record, first, window)
    _draw_depths((axes[0, 1], axes[0, 2]), (first, last), window)
    _draw_sigma(axes[1, 0], last, window)
    _draw_sources(axes[1, 1], record, last, window)
    _draw_states(axes[1, 2], last, window)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _panels(figure: Any, aspect: float, views: int) -> Any:
    """Return two rows of three axes in a figure that is just large enough for pictures of this aspect.

    Each has room for a title above and for a scale below, those of the second row for a legend of all views.
    """
    image_in = PANEL_IN * aspect
    legend_in = LINE_IN * (max(STATE_LINES, views + 1) + 2)
    height_in = 3 * TITLE_IN + SCALE_IN + 2 * image_in + legend_in
    figure.set_size_inches(3 * PANEL_IN + 4 * GAP_IN, height_in)
    axes = np.empty((2, 3), dtype=object)
    for row, column in np.ndindex(2, 3):
        bottom_in = legend_in + (1 - row) * (image_in + TITLE_IN + SCALE_IN)
        place = np.array([GAP_IN + column * (PANEL_IN + GAP_IN), bottom_in, PANEL_IN, image_in])
        axes[row, column] = figure.add_axes(place / np.tile(figure.get_size_inches(), 2))
    return axes


def _headline(record: Record, last: Step) -> str:
    ending = f"ended: {last.stop}" if last.stop is not None else "ended early"
    count = sum(view.refused is not None for view in record.views)
    refused = f", {count} refused" if count else ""
    return (
        f"{record.setup.part}: {last.recovered_px} of {last.missing_px} missing pixels on the parts recovered "
        f"({last.completeness:.0%}) with {last.index} further views{refused}, {ending}"
    )


def _window(record: Record, step: Step) -> Window:
    """Return rows and columns around the detected objects, the whole image where there are none."""
    height, width = step.depth.depth_m.shape
    if not step.objects:
        return slice(0, height), slice(0, width)
    centres = np.array([thing.hypotheses[0].camera_T_object[:3, 3] for thing in step.objects])
    u, v = record.camera.project(centres).T
    return _span(v, height, MARGIN * width), _span(u, width, MARGIN * width)


def _span(centres_px: FloatArray, size_px: int, margin_px: float) -> slice:
    return slice(max(0, int(centres_px.min() - margin_px)), min(size_px, int(centres_px.max() + margin_px) + 1))


def _draw_missing(axis: Axis, record: Record, first: Step, window: Window) -> None:
    image = (record.image if record.image is not None else first.frame.left)[window]
    bright = np.clip(image / max(1.0, float(np.percentile(image, 99.5))), 0.0, 1.0)
    shown = np.repeat(bright[..., None], 3, axis=2)
    missing = np.isnan(first.depth.depth_m[window])
    shown[missing] += MISSING_ALPHA * (_rgb(MISSING_COLOUR) - shown[missing])
    axis.imshow(shown, interpolation="none")
    axis.set_title(f"reference view {first.view.name}: no depth in red")


def _draw_depths(axes: tuple[Axis, Axis], steps: tuple[Step, Step], window: Window) -> None:
    """Draw both depth maps on one scale, from the 1st to the 99th percentile of the later one."""
    from matplotlib.colors import Normalize

    before_mm, after_mm = (step.depth.trusted_m[window] * 1e3 for step in steps)
    near, far = np.nanpercentile(after_mm, (1, 99)) if np.isfinite(after_mm).any() else (0.0, 1.0)
    for axis, depth_mm, title in zip(axes, (before_mm, after_mm), ("depth before", "depth after"), strict=True):
        _draw_scale(axis, depth_mm, Normalize(near, far), "viridis", "depth (mm)")
        axis.set_title(f"{title}: {np.isfinite(depth_mm).mean():.1%} of these pixels")


def _draw_sigma(axis: Axis, last: Step, window: Window) -> None:
    """Draw the standard deviation of what is trusted, from its 1st to its 99th percentile."""
    from matplotlib.colors import LogNorm

    sigma_mm = np.where(last.depth.trusted, last.depth.sigma_m, np.nan)[window] * 1e3
    known = np.isfinite(sigma_mm).any()
    low, middle, high = np.nanpercentile(sigma_mm, (1, 50, 99)) if known else (0.1, np.nan, 1.0)
    low = max(low, SMALLEST_SIGMA_MM)
    _draw_scale(axis, sigma_mm, LogNorm(low, max(high, 2 * low)), "plasma", "standard deviation of the depth (mm)")
    axis.set_title(f"how sure the depth is: median {middle:.2f} mm")


def _draw_scale(axis: Axis, image: FloatArray, norm: Any, colours: str, label: str) -> None:
    """Draw values by a colour map, with the bar under the picture that says which; black where there are none."""
    axis.set_facecolor("black")
    drawn = axis.imshow(image, cmap=colours, norm=norm, interpolation="none")
    height = axis.get_position().height * axis.figure.get_figheight()
    inset = axis.inset_axes((0.05, -0.2 / height, 0.9, 0.12 / height))
    ticks = norm.inverse(np.linspace(0.0, 1.0, TICKS))
    bar = axis.figure.colorbar(drawn, cax=inset, orientation="horizontal", label=label)
    bar.ax.set_xticks(ticks, [f"{value:.3g}" for value in ticks])
    bar.ax.minorticks_off()


def _draw_sources(axis: Axis, record: Record, last: Step, window: Window) -> None:
    source = np.where(last.depth.trusted, last.depth.source, -1)[window]
    layers = [(source == 0, REFERENCE_COLOUR, f"{record.views[0].view} (reference)")]
    for report in record.views[1:]:
        gains = f"expected {report.predicted_gain_px:.0f}, measured {report.measured_gain_px:.0f} px"
        said = "refused" if report.refused is not None else gains
        colour = VIEW_COLOURS[(report.index - 1) % len(VIEW_COLOURS)]
        layers.append((source == report.index, colour, f"{report.index}: {report.view}, {said}"))
    _draw_layers(axis, [*layers, (source < 0, NOTHING_COLOUR, "nothing trusted")])
    axis.set_title("which view gave the depth, the first where several did")


def _draw_states(axis: Axis, last: Step, window: Window) -> None:
    state = last.depth.state[window]
    layers: list[Layer] = []
    for each, colour in STATE_COLOURS.items():
        there = state == each
        label = f"{each.name.lower()}: {int(there.sum())} px"
        layers.append((_enlarged(there) if each in MARKS else there, colour, label))
    _draw_layers(axis, layers)
    axis.set_title("what the depth rests on")


def _draw_layers(axis: Axis, layers: list[Layer]) -> None:
    """Draw masks (H, W) in their colours, later ones over earlier ones, and write under them what they mean."""
    from matplotlib.patches import Patch

    painted = np.zeros((*layers[0][0].shape, 3))
    for mask, colour, _ in layers:
        painted[mask] = _rgb(colour)
    axis.imshow(painted, interpolation="none")
    handles: list[Any] = [Patch(facecolor=colour, edgecolor="black", label=label) for _, colour, label in layers]
    axis.legend(handles=handles, loc="upper left", bbox_to_anchor=(0, 0), frameon=False, borderaxespad=0.3)


def _enlarged(mask: BoolArray) -> BoolArray:
    """Return a mask (H, W) with the neighbours of its pixels in rows and columns."""
    padded = np.pad(mask, 1)
    return padded[1:-1, 1:-1] | padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]


def _rgb(colour: str) -> FloatArray:
    from matplotlib.colors import to_rgb

    return np.array(to_rgb(colour))
