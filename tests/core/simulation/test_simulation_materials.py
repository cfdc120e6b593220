"""The microfacet surfaces keep the laws of light: reciprocity, energy, and Lambert's cosine."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sidelong.errors import UnknownNameError
from sidelong.simulation.materials import MATERIALS, Surface, reflectance, surface_table, unit

NORMAL = np.array([[0.0, 0.0, 1.0]])


def direction(tilt_rad, turn_rad):
    return np.stack(
        np.broadcast_arrays(
            np.sin(tilt_rad) * np.cos(turn_rad), np.sin(tilt_rad) * np.sin(turn_rad), np.cos(tilt_rad) + 0.0 * turn_rad
        ),
        axis=-1,
    ).reshape(-1, 3)


@settings(max_examples=200, deadline=None)
@given(
    name=st.sampled_from(sorted(MATERIALS)),
    tilts=st.tuples(st.floats(0.0, 1.5), st.floats(0.0, 1.5)),
    turn=st.floats(0.0, 6.3),
)
def test_light_and_camera_may_change_places(name, tilts, turn):
    surface = surface_table([name])
    one, other = direction(tilts[0], 0.0), direction(tilts[1], turn)
    there, back = reflectance(surface, one, other, NORMAL), reflectance(surface, other, one, NORMAL)
    assert there == pytest.approx(back, rel=1e-9)
    assert there[0] > 0


@pytest.mark.parametrize("name", sorted(MATERIALS))
@pytest.mark.parametrize("tilt_rad", [0.0, 0.5, 1.0, 1.3, 1.5])
def test_no_surface_returns_more_light_than_falls_on_it(name, tilt_rad):
    # midpoint rule over the hemisphere, in the mirror direction's own neighbourhood fine enough for alpha 0.1
    tilts = (np.arange(900) + 0.5) * (np.pi / 2 / 900)
    turns = (np.arange(720) + 0.5) * (2 * np.pi / 720)
    grid_tilt, grid_turn = np.meshgrid(tilts, turns, indexing="ij")
    to_camera = direction(grid_tilt, grid_turn)
    to_light = np.broadcast_to(direction(tilt_rad, 0.0), to_camera.shape)
    normals = np.broadcast_to(NORMAL, to_camera.shape)
    weight = (np.cos(grid_tilt) * np.sin(grid_tilt)).ravel() * (np.pi / 2 / 900) * (2 * np.pi / 720)
    albedo = float((reflectance(surface_table([name]), to_light, to_camera, normals) * weight).sum())
    assert MATERIALS[name].diffuse * 0.999 <= albedo <= 1.0


def test_a_mirror_lobe_returns_its_fresnel_share_at_normal_incidence():
    # a narrow lobe loses nothing to masking: its albedo is F0
    tilts = (np.arange(4000) + 0.5) * (0.6 / 4000)
    to_camera = direction(tilts, 0.0)
    normals = np.broadcast_to(NORMAL, to_camera.shape)
    surface = Surface(np.array([0.0]), np.array([0.6]), np.array([0.02]))
    brdf = reflectance(surface, normals, to_camera, normals)
    albedo = float((brdf * np.cos(tilts) * np.sin(tilts)).sum() * 2 * np.pi * 0.6 / 4000)
    assert albedo == pytest.approx(0.6, rel=0.01)


def test_a_matte_surface_is_lambertian():
    angles = np.linspace(0.0, 1.5, 20)
    normals = np.broadcast_to(NORMAL, (20, 3))
    brdf = reflectance(surface_table(["matte"]), direction(angles, 1.0), direction(angles[::-1], 0.0), normals)
    assert brdf == pytest.approx(np.full(20, MATERIALS["matte"].diffuse / np.pi))


def test_nothing_is_returned_from_below():
    below = direction(2.0, 0.0)
    assert reflectance(surface_table(["stainless"]), below, NORMAL, NORMAL) == 0.0
    assert reflectance(surface_table(["stainless"]), NORMAL, below, NORMAL) == 0.0


def test_a_wide_lamp_lowers_and_widens_the_highlight():
    surface, aside = surface_table(["plated"]), direction(0.6, 0.0)
    wide = surface.widened(0.3)
    assert reflectance(wide, NORMAL, NORMAL, NORMAL) < reflectance(surface, NORMAL, NORMAL, NORMAL)
    assert reflectance(wide, aside, NORMAL, NORMAL) > reflectance(surface, aside, NORMAL, NORMAL)


def test_unit_gives_length_one():
    assert np.linalg.norm(unit(np.array([[3.0, 4.0, 12.0], [0.0, 0.0, 1e-3]])), axis=1) == pytest.approx([1.0, 1.0])


def test_an_unknown_material_is_refused_with_the_known_names():
    with pytest.raises(
        UnknownNameError, match=r"'glass' is unknown, known are stainless, plated, matte, black_plastic, printed"
    ):
        surface_table(["matte", "glass"])
