"""A hand-eye calibration as a picture a person can judge."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from sidelong.calibration.hand_eye.solution import HandEye
from sidelong.types import FloatArray

ARROW_SHARE = 0.05
"""Of the image's width: length of a typical arrow."""

_BEHIND_TEXT = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}


def draw_hand_eye(result: HandEye) -> bytes:
    """Draw where the corners miss their prediction, and bars for each pose in px, mm and degrees; return a PNG.

    Arrows of one image in one direction are the arm's error; all around are the detector's; a pattern over all images
    is the camera's. Poses left out are grey.
    """
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(13, 5.2), dpi=110, layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.15, 1.0))
    _draw_arrows(left.subplots(), result)
    values = (result.residual_px, 1e3 * result.residual_m, np.rad2deg(result.residual_rad))
    axes = right.subplots(3, 1, sharex=True)
    for axis, value, label in zip(axes, values, ("corners, px rms", "board, mm", "board, deg"), strict=True):
        _draw_bars(axis, value, label, result)
    axes[-1].set_xticks(range(len(result.names)), result.names, rotation=90 if len(result.names) > 6 else 0, fontsize=8)
    error_mm = 1e3 * float(np.linalg.norm(result.standard_error_m))
    error_deg = np.rad2deg(float(np.linalg.norm(result.standard_error_rad)))
    figure.suptitle(
        f"camera on the flange from {result.poses} poses: standard error {error_mm:.2f} mm, {error_deg:.3f} deg; "
        f"corners {result.rms_px:.2f} px rms"
    )
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()


def _draw_arrows(axis: Any, result: HandEye) -> None:
    from matplotlib import colormaps

    width = max(float(corners[:, 0].max()) for corners in result.corners_px)
    typical = float(np.median(np.linalg.norm(_used(result), axis=1)))
    times = ARROW_SHARE * width / max(typical, 1e-9)
    times = float(f"{times:.1g}")  # a round number for the reader
    colours = colormaps["turbo"](np.linspace(0.05, 0.95, len(result.names)))
    for corners, missed, used, colour in zip(result.corners_px, result.missed_px, result.used, colours, strict=True):
        axis.quiver(
            corners[:, 0], corners[:, 1], missed[:, 0] * times, missed[:, 1] * times, angles="xy", scale_units="xy",
            scale=1.0, width=0.002, color=colour if used else "0.7", zorder=2 if used else 1,
        )  # fmt: skip
    # an arrow of a wrong pose may be a hundred times longer: the frame is that of the corners
    every = np.concatenate(result.corners_px)
    margin = 2 * ARROW_SHARE * width
    axis.set_xlim(every[:, 0].min() - margin, every[:, 0].max() + margin)
    axis.set_ylim(every[:, 1].max() + margin, every[:, 1].min() - margin)
    axis.set_aspect("equal")
    axis.set_xlabel("u, px")
    axis.set_ylabel("v, px")
    axis.set_title(f"found less predicted, {times:g} times as long; a colour for each image", fontsize=10)


def _draw_bars(axis: Any, value: FloatArray, label: str, result: HandEye) -> None:
    places = np.arange(len(value))
    axis.bar(places[result.used], value[result.used], color="tab:blue")
    axis.bar(places[~result.used], value[~result.used], color="0.7", hatch="//")
    # left-out poses may be a hundred times worse: they are cut, their number is not
    top = 1.6 * float(value[result.used].max())
    axis.set_ylim(0, max(top, 1e-9))
    for place in places[~result.used]:
        axis.annotate(f"{value[place]:.3g}", (place, 0.9 * top), ha="center", fontsize=8, bbox=_BEHIND_TEXT)
    axis.set_ylabel(label)
    axis.grid(axis="y", alpha=0.3)


def _used(result: HandEye) -> FloatArray:
    return np.concatenate([missed for missed, used in zip(result.missed_px, result.used, strict=True) if used])
