"""What the pictures of calibrations have in common."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from sidelong.types import FloatArray


def png(figure: Any) -> bytes:
    """Return a matplotlib figure as PNG."""
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()


def show_map(
    figure: Any, axis: Any, values: FloatArray, title: str, limits: tuple[float, float] | None = None, colours: str = ""
) -> None:
    """Draw an image (H, W) with a colour bar; NaN is grey. Without limits the middle 98 % of the values span them."""
    known = values[np.isfinite(values)]
    low, high = limits or ((float(q) for q in np.percentile(known, (1, 99))) if known.size else (0.0, 1.0))
    axis.set_facecolor("0.6")
    image = axis.imshow(values, vmin=low, vmax=high, cmap=colours or "viridis", interpolation="nearest")
    figure.colorbar(image, ax=axis, shrink=0.8)
    axis.set_title(title, fontsize=10)
    axis.set_xticks([])
    axis.set_yticks([])
