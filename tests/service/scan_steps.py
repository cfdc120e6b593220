"""Steps of a scan as the fusion could give them, without one."""

from __future__ import annotations

import numpy as np

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.types import CompletedDepth, Frame, FusedView, PixelState, Projector, StateArray, Step, View

CAMERA = PinholeCamera(200, 160, 250.0, 250.0, 99.5, 79.5)
SHAPE = CAMERA.height, CAMERA.width
SOURCES = {PixelState.MISSING: -1, PixelState.MODELLED: -1, PixelState.MEASURED: 0, PixelState.CONTRADICTED: 0}


def fused(refused: str | None = None, contradicted_px: int = 0, agreement: float = 0.98) -> FusedView:
    """What the fusion made of a view that stands 0.1 m beside the reference."""
    pose = np.eye(4)
    pose[0, 3] = 0.1
    return FusedView(
        reference_T_view=pose, refused=refused, shift_m=0.21e-3, turn_rad=1e-3, sigma_shift_m=1e-4, sigma_turn_rad=2e-4,
        shared_points=400, agreement=agreement, filled_px=0 if refused else 1500, contradicted_px=contradicted_px,
    )  # fmt: skip


def step(state: StateArray, index: int = 0, of: FusedView | None = None) -> Step:
    """A step whose completed depth has these states (H, W), all at 0.7 m; what is completed comes from its view."""
    view = View(f"view_{index}", np.eye(4))
    depth_m = np.where(state == PixelState.MISSING, np.nan, 0.7)
    source = np.vectorize(lambda value: SOURCES.get(PixelState(value), index), otypes=[np.intp])(state)
    left = np.full(SHAPE, 60, dtype=np.uint8)
    return Step(
        index=index, view=view, frame=Frame(view, left, None, depth_m, Projector.DOTS, 0.01), objects=(),
        depth=CompletedDepth(depth_m, np.where(np.isnan(depth_m), np.nan, 3e-4), source, state),
        missing_px=4000, recovered_px=1000 * index, predicted_gain_px=900.0, measured_gain_px=1000.0, scores=(),
        stage_s={"move": 1.0, "capture": 0.5, "fuse": 0.1}, stop=None, fused=of,
    )  # fmt: skip
