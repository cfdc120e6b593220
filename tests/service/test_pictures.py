"""The picture of the depth: what is drawn of each state, and scans of which there is little to draw."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import trimesh
from scan_steps import CAMERA, SHAPE, fused, step

from sidelong.geometry.mesh import part_from_arrays
from sidelong.types import PixelState, StateArray
from sidelong_service.artifacts import Record
from sidelong_service.models import Setup
from sidelong_service.pictures import MARKS, STATE_COLOURS, VIEW_COLOURS, draw_depths

SETUP = Setup(
    part="gear", camera="c", arm="a", width_px=SHAPE[1], height_px=SHAPE[0], candidates=5, left_out=(), recipe={}
)
BOX = trimesh.creation.box((0.02, 0.02, 0.02))
PART = part_from_arrays("gear", np.asarray(BOX.vertices), np.asarray(BOX.faces, dtype=np.intp))


def record(*states: StateArray, refused: str | None = None) -> Record:
    """A scan whose depth had these states after each view; the last one may have been refused."""
    here = Record(CAMERA, PART, SETUP)
    for index, state in enumerate(states):
        last = index == len(states) - 1
        here.add(step(state, index, fused(refused if last else None) if index else None))
    return here


def drawn(here: Record) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(draw_depths(here), np.uint8), cv2.IMREAD_COLOR_RGB)
    assert picture is not None
    return picture.astype(int)


def share(picture: np.ndarray, colour: str) -> float:
    """Return the share of the pixels that have exactly this colour."""
    rgb = [int(colour[at : at + 2], 16) for at in (1, 3, 5)]
    return float((picture == rgb).all(axis=2).mean())


def states(*blocks: PixelState) -> StateArray:
    """Return a map that is measured but for a block of 40x40 pixels of each state."""
    state = np.full(SHAPE, PixelState.MEASURED, dtype=np.uint8)
    for at, block in enumerate(blocks):
        state[20:60, 10 + 45 * at : 50 + 45 * at] = block
    return state


BLOCK = 40 * 40 / (SHAPE[0] * SHAPE[1]) * 0.1
"""What a block is of the picture at least: six panels, and some room around them."""


@pytest.mark.parametrize("state", [s for s in PixelState if s not in (PixelState.MEASURED, PixelState.MISSING)])
def test_each_state_is_drawn_in_its_colour(state: PixelState) -> None:
    before, after = states(PixelState.MISSING), states(state)
    colour = STATE_COLOURS[state]
    without, with_it = (drawn(record(before, other)) for other in (before, after))
    assert share(with_it, colour) - share(without, colour) > BLOCK


@pytest.mark.parametrize("state", MARKS)
def test_a_single_pixel_of_a_rare_state_is_drawn_larger(state: PixelState) -> None:
    after = states()
    after[80, 100] = state
    cross = share(drawn(record(states(), after)), STATE_COLOURS[state])
    after[80:83, 100:103] = state
    assert cross - share(drawn(record(states(), states())), STATE_COLOURS[state]) > 3 * BLOCK / 40**2


def test_the_view_that_completed_pixels_has_its_own_colour() -> None:
    before, after = states(PixelState.MISSING), states(PixelState.COMPLETED)
    first, second = record(before, after), record(before, before, after)
    assert share(drawn(first), VIEW_COLOURS[0]) > BLOCK
    assert share(drawn(second), VIEW_COLOURS[1]) > BLOCK > share(drawn(second), VIEW_COLOURS[0])


def test_depth_that_is_not_trusted_is_black_in_the_depth_afterwards() -> None:
    """A contradicted block is in the depth before, and no longer in the one after, in sigma and in the sources."""
    kept, contradicted = (drawn(record(states(), states(s))) for s in (PixelState.MEASURED, PixelState.CONTRADICTED))
    assert share(contradicted, "#000000") - share(kept, "#000000") > 2.5 * BLOCK


@pytest.mark.parametrize("state", list(PixelState))
def test_a_scan_of_one_state_only_is_drawn_without_a_warning(state: PixelState) -> None:
    assert drawn(record(np.full(SHAPE, state, dtype=np.uint8))).std() > 5


def test_more_views_than_colours_and_a_refused_one_only_make_the_picture_taller() -> None:
    few, many = drawn(record(states(), states())), drawn(record(*[states()] * 12, refused="too far"))
    assert few.shape[1] == many.shape[1] == 1800
    assert few.shape[0] < many.shape[0] < 2 * few.shape[0]


def test_without_a_reference_view_there_is_no_picture() -> None:
    with pytest.raises(ValueError, match="no reference view yet"):
        draw_depths(record())
