"""Reliability: of the pixels that were promised depth with probability p, is the share p measured?"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from sidelong.calibration.sensing.scores import BINS, equal_width, scores_of
from sidelong.types import BoolArray, FloatArray, Forecast

Z_95 = 1.959963984540054
"""Standard deviations on either side that hold 95 % of a normal distribution."""


class ReliabilityBin(BaseModel):
    """The pixels whose probability falls between ``low`` and ``high`` (1 belongs to the last bin)."""

    model_config = ConfigDict(frozen=True)

    low: float
    high: float
    pixels: float
    """By weight: what a point stands for, times the probability of its hypothesis."""
    points: int
    forecast: float
    """Mean probability."""
    measured: float
    """Share that was measured."""
    measured_low: float
    measured_high: float
    """Wilson's interval of that share, 95 %, as if points were independent."""


class ReliabilityReport(BaseModel):
    """Forecasts beside what happened. See :class:`sidelong.calibration.forecast_scores.Scores`."""

    model_config = ConfigDict(frozen=True)

    views: int
    points: int
    predicted_px: float
    measured_px: float
    log_loss: float
    brier: float
    ece: float
    ece_adaptive: float
    bins: tuple[ReliabilityBin, ...]
    """Those that hold anything."""


@dataclass(frozen=True, eq=False)
class Reliability:
    """Gathers the forecasts of views, one after another.

    reliability = Reliability()
    for step in scan(...):
        reliability = reliability.add(step.forecast)
    """

    forecasts: tuple[Forecast, ...] = ()

    def add(self, forecast: Forecast | None) -> Reliability:
        """Return this with the forecast of one more view; the reference view has none."""
        return self if forecast is None else Reliability((*self.forecasts, forecast))

    def report(self) -> ReliabilityReport:
        """Return bins and scores; all zero and no bins where nothing was forecast."""
        p, weight, measured = self._joined()
        scores = scores_of(p, measured, weight)
        return ReliabilityReport(
            views=len(self.forecasts),
            points=len(p),
            predicted_px=float(weight @ p),
            measured_px=float(weight @ measured),
            log_loss=scores.log_loss,
            brier=scores.brier,
            ece=scores.ece,
            ece_adaptive=scores.ece_adaptive,
            bins=_bins(p, weight, measured),
        )

    def _joined(self) -> tuple[FloatArray, FloatArray, BoolArray]:
        return (
            np.concatenate([np.zeros(0), *(forecast.probability for forecast in self.forecasts)]),
            np.concatenate([np.zeros(0), *(forecast.weight for forecast in self.forecasts)]),
            np.concatenate([np.zeros(0, np.bool_), *(forecast.measured for forecast in self.forecasts)]),
        )


def wilson(share: float, count: float) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share of ``count`` trials; (0, 1) for none."""
    if count <= 0:
        return 0.0, 1.0
    squared = Z_95**2 / count
    middle = (share + squared / 2) / (1 + squared)
    half = Z_95 / (1 + squared) * float(np.sqrt(share * (1 - share) / count + squared / (4 * count)))
    # at a share of 0 or 1 the interval ends there but for rounding
    return max(0.0, min(middle - half, share)), min(1.0, max(middle + half, share))


def draw(report: ReliabilityReport, title: str) -> bytes:
    """Draw the measured share against the forecast, and how many pixels each bin holds; return a PNG."""
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(5.2, 5.6), dpi=110, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    draw_on(above, below, report)
    sums = f"predicted {report.predicted_px:.0f} px, measured {report.measured_px:.0f} px"
    figure.suptitle(f"{title}\n{sums}\n{told(report)}", fontsize="medium")
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()


def told(report: ReliabilityReport) -> str:
    """Return the scores in words."""
    return f"ECE {report.ece:.3f}, Brier {report.brier:.3f}, log-loss {report.log_loss:.3f}"


def draw_on(above: Any, below: Any, report: ReliabilityReport) -> None:
    """Draw the diagram on two axes: shares, and below how many pixels each bin holds."""
    forecast, measured = ([getattr(each, name) for each in report.bins] for name in ("forecast", "measured"))
    reach = [
        [each.measured - each.measured_low for each in report.bins],
        [each.measured_high - each.measured for each in report.bins],
    ]
    above.plot([0, 1], [0, 1], color="grey", linestyle="--", linewidth=1, label="as promised")
    above.errorbar(forecast, measured, yerr=reach, marker="o", capsize=3, label="measured, 95 %")
    above.set_ylim(0, 1)
    above.set_ylabel("share measured")
    above.legend(loc="upper left")
    below.bar([(each.low + each.high) / 2 for each in report.bins], [each.pixels for each in report.bins], 0.9 / BINS)
    below.set_ylabel("pixels")
    below.set_xlim(0, 1)
    below.set_xlabel("probability of depth, predicted")
    for axis in (above, below):
        axis.grid(alpha=0.3)


def _bins(p: FloatArray, weight: FloatArray, measured: BoolArray) -> tuple[ReliabilityBin, ...]:
    inside = equal_width(p)
    filled = [k for k in range(BINS) if weight[inside == k].sum() > 0]
    return tuple(_bin(k, p[inside == k], weight[inside == k], measured[inside == k]) for k in filled)


def _bin(k: int, p: FloatArray, weight: FloatArray, measured: BoolArray) -> ReliabilityBin:
    pixels = float(weight.sum())
    share = float(weight @ measured) / pixels
    # points of unlike weight say less than as many of equal weight (Kish)
    low, high = wilson(min(share, 1.0), pixels**2 / float(weight @ weight))
    return ReliabilityBin(
        low=k / BINS,
        high=(k + 1) / BINS,
        pixels=pixels,
        points=len(p),
        forecast=float(weight @ p) / pixels,
        measured=share,
        measured_low=low,
        measured_high=high,
    )
