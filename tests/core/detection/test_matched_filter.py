"""The matched filter against its formula, and what it makes of backgrounds of any strength."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sidelong.detection.gradient_cells import DIRECTIONS, gradient_cells
from sidelong.detection.matched_filter import DIAGONAL, TemplateBank, search

CELL = 6
GRID = np.arange(CELL / 2, 240, CELL)
WINDOW = np.hypot(*np.mgrid[-3:4, -3:4]) <= 3.2
D = int(WINDOW.sum()) * DIRECTIONS


def _bank(count: int = 30, size: int = 12) -> TemplateBank:
    rng = np.random.default_rng(1)
    basis = np.linalg.qr(rng.normal(size=(D, size)))[0].T.astype(np.float32)
    return TemplateBank(WINDOW, basis, rng.normal(size=(count, size)).astype(np.float32))


def _noise_cells(seed: int = 0, strength: float = 1.0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(128, 20, (240, 240))
    return strength * gradient_cells(np.clip(noise, 0, 255).astype(np.uint8), GRID, GRID, CELL, 3.0)


def _everything(cells: np.ndarray, bank: TemplateBank) -> np.ndarray:
    """All scores (R, C, N), from the formula with the covariance written out pair by pair."""
    centred = (cells - cells.mean(axis=(0, 1))).astype(np.float64)
    rows, columns = centred.shape[:2]
    lag: dict[tuple[int, int], np.ndarray] = {}
    at = np.argwhere(WINDOW)
    for down, across in {tuple(map(int, a - b)) for a in at for b in at}:
        first = centred[max(down, 0) : rows + min(down, 0), max(across, 0) : columns + min(across, 0)]
        second = centred[max(-down, 0) : rows + min(-down, 0), max(-across, 0) : columns + min(-across, 0)]
        lag[down, across] = np.einsum("rck,rcl->kl", first, second) / (rows * columns)
    covariance = np.block([[lag[tuple(map(int, a - b))] for b in at] for a in at])
    covariance += DIAGONAL * np.trace(covariance) / D * np.eye(D)
    templates = (bank.weights @ bank.basis).astype(np.float64)
    filters = np.linalg.solve(covariance, templates.T)
    filters /= np.sqrt(np.einsum("nd,dn->n", templates, filters))
    padded = np.pad(centred, ((3, 3), (3, 3), (0, 0)))
    shown = [[padded[r : r + 7, c : c + 7][WINDOW].ravel() for c in range(columns)] for r in range(rows)]
    return np.array(shown) @ filters


def test_scores_are_those_of_the_formula():
    cells, bank = _noise_cells(), _bank()
    expected = _everything(cells, bank)
    found = search(cells, np.ones(cells.shape[:2], np.bool_), bank, 0.5, 1000, 10**6)
    assert found.total == len(found.score) == int((expected >= 0.5).sum())
    np.testing.assert_allclose(found.score, expected[found.place[:, 0], found.place[:, 1], found.template], atol=1e-3)
    assert (np.diff(found.score) <= 0).all()


def test_a_hidden_template_is_found_where_it_is():
    bank = _bank()
    cells = _noise_cells()
    shown = np.zeros((7, 7, DIRECTIONS), np.float32)
    shown[WINDOW] = (bank.weights[7] @ bank.basis).reshape(-1, DIRECTIONS)
    cells[10:17, 20:27] += 10 * cells.std() * shown
    found = search(cells, np.ones(cells.shape[:2], np.bool_), bank, 3.0, 5, 100)
    assert tuple(found.place[0]) == (13, 23)
    assert found.template[0] == 7


@given(seed=st.integers(0, 1000), strength=st.floats(0.02, 5.0))
def test_a_background_of_any_strength_has_the_same_false_alarms(seed: int, strength: float):
    cells = _noise_cells(seed, strength)
    found = search(cells, np.ones(cells.shape[:2], np.bool_), _bank(), 4.0, 5, 10**6)
    # one standard deviation at most, since the covariance is enlarged: 1,600 places, 30 templates
    assert found.total < 20


def test_only_asked_places_are_tried_and_only_the_best_are_kept():
    cells, bank = _noise_cells(), _bank()
    places = np.zeros(cells.shape[:2], np.bool_)
    places[5:9, 30] = True
    every = search(cells, places, bank, 1e-3, 1000, 10**6)
    assert {tuple(place) for place in every.place.tolist()} <= {(row, 30) for row in range(5, 9)}
    few = search(cells, places, bank, 1e-3, 2, 5)
    assert (few.total, len(few.score)) == (8, 5)
    assert few.score[0] == every.score[0]


@pytest.mark.parametrize("cells", [np.zeros((20, 20, DIRECTIONS), np.float32), np.ones((1, 1, DIRECTIONS), np.float32)])
def test_nothing_is_found_where_nothing_is(cells: np.ndarray):
    found = search(cells, np.ones(cells.shape[:2], np.bool_), _bank(), 1.0, 5, 100)
    assert found.total == 0
    assert search(cells, np.zeros(cells.shape[:2], np.bool_), _bank(), 1.0, 5, 100).total == 0


def test_an_edge_counts_in_its_direction_whatever_its_sign_and_contrast():
    image = np.full((240, 240), 40, np.uint8)
    image[:, 120:] = 200
    upright = gradient_cells(image, GRID, GRID, CELL, 3.0)
    assert np.argmax(upright[20, 20]) == 0
    np.testing.assert_allclose(gradient_cells(240 - image, GRID, GRID, CELL, 3.0), upright, atol=1e-5)
    np.testing.assert_allclose(gradient_cells(image // 4, GRID, GRID, CELL, 3.0), upright, rtol=0.2, atol=0.02)
    lying = gradient_cells(np.ascontiguousarray(image.T), GRID, GRID, CELL, 3.0)
    np.testing.assert_allclose(np.roll(lying, DIRECTIONS // 2, axis=-1).transpose(1, 0, 2), upright, atol=1e-3)
