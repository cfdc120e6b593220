"""Simulated parts are closed, of a size a cell handles, and finely cut."""

import numpy as np
import pytest
import trimesh

from sidelong.errors import UnknownNameError
from sidelong.simulation.lofting import joined, loft, polar_ring, rectangle_ring
from sidelong.simulation.materials import MATERIALS
from sidelong.simulation.parts import PART_NAMES, simulated_part


@pytest.mark.parametrize("name", PART_NAMES)
def test_each_part_is_closed_centred_and_small_enough_to_trace(name):
    part = simulated_part(name)
    mesh = trimesh.Trimesh(part.vertices_m, part.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert 0.03 <= np.ptp(part.vertices_m, axis=0).max() <= 0.08
    assert len(part.triangles) <= 20_000
    assert np.abs(part.centre_m).max() < 1e-9
    assert set(part.materials) <= set(MATERIALS)


@pytest.mark.parametrize("name", PART_NAMES)
def test_no_triangle_is_degenerate(name):
    part = simulated_part(name)
    assert np.allclose(np.linalg.norm(part.triangle_normals, axis=1), 1.0)


def test_an_unknown_part_is_refused_with_the_known_names():
    with pytest.raises(UnknownNameError, match=r"'teapot' is unknown, known are tube_fitting, hex_screw"):
        simulated_part("teapot")


def test_a_loft_of_two_circles_has_the_volume_of_the_cylinder():
    vertices, triangles = loft([polar_ring(0.5, 0.0, 720), polar_ring(0.5, 2.0, 720)])
    volume = trimesh.Trimesh(vertices, triangles, process=False).volume
    assert volume == pytest.approx(np.pi * 0.25 * 2.0, rel=2e-5)


def test_a_cyclic_loft_leaves_the_bore_open():
    rings = [polar_ring(1.0, 0.0, 360), polar_ring(1.0, 1.0, 360), polar_ring(0.5, 1.0, 360), polar_ring(0.5, 0.0, 360)]
    mesh = trimesh.Trimesh(*loft(rings, cyclic=True), process=False)
    assert mesh.is_watertight
    assert mesh.euler_number == 0
    assert mesh.volume == pytest.approx(np.pi * 0.75, rel=1e-4)


def test_lofts_face_outwards_whichever_way_their_rings_run():
    rings = [rectangle_ring(1.0, 1.0, 0.0), rectangle_ring(1.0, 1.0, 1.0)]
    up, down = loft(rings), loft(rings[::-1])
    volumes = [trimesh.Trimesh(*mesh, process=False).volume for mesh in (up, down, joined([up, down]))]
    assert volumes == pytest.approx([1.0, 1.0, 2.0])
