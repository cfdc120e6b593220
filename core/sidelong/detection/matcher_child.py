"""The child process that matches. Started by :mod:`.matcher_process`.

Reads ``(image, region, settings)`` and answers ``(centres_px, scores, rows, total)`` or a message.
"""

from __future__ import annotations

import sys
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sidelong.detection.gradient_cells import gradient_cells
from sidelong.detection.matched_filter import TemplateBank, search
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.templates import read_bank
from sidelong.types import BoolArray, FloatArray, GrayImage, IntArray


def main(descriptor: int, folder: Path) -> None:
    """Answer until the parent closes its end."""
    channel: Connection[Any, Any] = Connection(descriptor)
    bank = read_bank(folder)
    channel.send("ready")
    while True:
        try:
            image, region, settings = channel.recv()
        except EOFError:
            return
        try:
            channel.send(match(image, region, bank, DetectionSettings.model_validate(settings)))
        except (cv2.error, np.linalg.LinAlgError, MemoryError) as error:
            channel.send(f"{type(error).__name__}: {error}")


def match(
    image: GrayImage, region: BoolArray | None, bank: TemplateBank, settings: DetectionSettings
) -> tuple[FloatArray, FloatArray, IntArray, int]:
    """Return centres (M, 2) as (u, v), scores (M,) and templates (M,), best first, and the number of all matches."""
    cell = settings.cell_px
    top, left, bottom, right = _needed(image.shape, region, len(bank.window) // 2 * cell)
    image = image[top:bottom, left:right]
    rows_px, columns_px = (np.arange(cell / 2, side, cell) for side in image.shape)
    places = np.ones((len(rows_px), len(columns_px)), np.bool_)
    if region is not None:
        region = region[top:bottom, left:right]
        places = region[np.ix_(rows_px.astype(np.intp), columns_px.astype(np.intp))]
    cells = gradient_cells(image, rows_px, columns_px, cell, settings.weak_gradient, region)
    found = search(cells, places, bank, settings.match_threshold, settings.matches_per_place, settings.max_matches)
    centres_px = np.stack([left + columns_px[found.place[:, 1]], top + rows_px[found.place[:, 0]]], axis=-1)
    return centres_px, found.score.astype(np.float64), found.template, found.total


def _needed(shape: tuple[int, ...], region: BoolArray | None, margin_px: int) -> tuple[int, int, int, int]:
    """Return (top, left, bottom, right) of what templates centred in the region look at."""
    if region is None:
        return 0, 0, shape[0], shape[1]
    where = np.argwhere(region)
    if len(where) == 0:
        return 0, 0, 1, 1
    (top, left), (bottom, right) = where.min(axis=0) - margin_px, where.max(axis=0) + 1 + margin_px
    return max(int(top), 0), max(int(left), 0), min(int(bottom), shape[0]), min(int(right), shape[1])


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))
