"""The parts of the simulated cell: made of rings, watertight, sized like those of the ROBI data set (3 to 8 cm).

Each stands along the z axis of its own frame, whose origin is the centre of its bounding box. Normals decide where a
highlight falls, so curved faces are cut finely: no facet turns by more than 4 degrees about the axis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from sidelong.errors import UnknownNameError
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.simulation.lofting import joined, loft, polar_ring, ring_angles_rad
from sidelong.types import FloatArray, IntArray

RING_POINTS = 96
"""Points of a ring: divisible by 12, so that a hexagon has its corners and its middles on points."""

Mesh = tuple[FloatArray, IntArray]


def simulated_part(name: str) -> Part:
    """Return a part of the simulated cell.

    Raises
    ------
    UnknownNameError
        The name is not one of ``PART_NAMES``.
    """
    if name not in _BUILDERS:
        raise UnknownNameError(f"simulated part: {name!r} is unknown, known are {', '.join(PART_NAMES)}")
    build, material = _BUILDERS[name]
    vertices_mm, triangles = build()
    vertices_mm = vertices_mm - (vertices_mm.min(axis=0) + vertices_mm.max(axis=0)) / 2
    return part_from_arrays(name, vertices_mm * 1e-3, triangles, materials=(material,))


def _tube_fitting() -> Mesh:
    """Two hexagon nuts and a hexagon body on a tube, 54.5 mm long, bored through."""
    rings = [
        *_cylinder(0.0, 9.0, radius=5.5),
        *_hexagon_prism(9.0, 21.5, across_flats=22.0),
        *_cylinder(21.5, 24.5, radius=8.5),
        *_hexagon_prism(24.5, 32.0, across_flats=20.0),
        *_cylinder(32.0, 35.0, radius=8.5),
        *_hexagon_prism(35.0, 47.5, across_flats=22.0),
        *_cylinder(47.5, 54.5, radius=5.5),
        *_cylinder(54.5, 0.0, radius=3.8),
    ]
    return loft(rings, cyclic=True)


def _hex_screw() -> Mesh:
    """An M16 x 50 screw; its thread is a stack of ridges."""
    return loft([*_hexagon_prism(0.0, 10.0, across_flats=24.0), *_cylinder(10.0, 32.0, 8.0), *_thread(32.0, 60.0, 8.0)])


def _eye_bolt() -> Mesh:
    """A ring on a collar and a threaded shank, 77 mm: two closed shells that overlap."""
    shank = [*_thread(0.0, 20.0, 7.0), *_cylinder(20.0, 24.0, 7.0), *_cylinder(24.0, 29.0, 11.0)]
    across_mm, along_mm = (polar_ring(6.5, 0.0, 48)[:, :2] + (18.0, 0.0)).T
    turns = ring_angles_rad(RING_POINTS)
    ring = [np.stack([across_mm * np.cos(t), along_mm, 52.0 + across_mm * np.sin(t)], axis=-1) for t in turns]
    return joined([loft(shank), loft(ring, cyclic=True)])


def _gear() -> Mesh:
    """A spur gear of module 1.5 with 24 teeth and a hub, bored through."""
    points = 24 * 12
    rings = [
        *(polar_ring(_toothed_mm(points) - chamfer, z, points) for chamfer, z in ((0.4, 0.0), (0.0, 0.4))),
        *(polar_ring(_toothed_mm(points) - chamfer, z, points) for chamfer, z in ((0.0, 9.6), (0.4, 10.0))),
        *_cylinder(10.0, 15.0, radius=10.0, points=points),
        *_cylinder(15.5, 0.0, radius=5.0, points=points),
    ]
    return loft(rings, cyclic=True)


def _toothed_mm(points: int) -> FloatArray:
    """Radius of a 24-tooth rim: straight flanks, as wide as an involute at the pitch circle (18 mm)."""
    phase = ring_angles_rad(points) * 24 / (2.0 * np.pi) % 1.0
    from_tooth = np.abs(phase - 0.5)
    return np.interp(from_tooth, [0.14, 0.34], [19.5, 16.1])


def _cylinder(z_from: float, z_to: float, radius: float, points: int = RING_POINTS) -> list[FloatArray]:
    return [polar_ring(radius, z_from, points), polar_ring(radius, z_to, points)]


def _hexagon_prism(z_from: float, z_to: float, across_flats: float) -> list[FloatArray]:
    """Rings of a hexagon whose corners are turned off by a 30 degree cone, as on every nut."""
    from_flat_rad = ring_angles_rad(RING_POINTS) % (np.pi / 3) - np.pi / 6
    hexagon = across_flats / 2 / np.cos(from_flat_rad)
    deepest_mm = float(hexagon.max()) - across_flats / 2
    starts: list[FloatArray] = []
    ends: list[FloatArray] = []
    for turned_mm in (deepest_mm * share for share in (0.0, 1 / 3, 2 / 3, 1.0)):
        radius = np.minimum(hexagon, across_flats / 2 + turned_mm)
        height_mm = turned_mm * float(np.tan(np.pi / 6))
        starts.append(polar_ring(radius, z_from + height_mm, RING_POINTS))
        ends.insert(0, polar_ring(radius, z_to - height_mm, RING_POINTS))
    return starts + ends


def _thread(z_from: float, z_to: float, radius: float, pitch: float = 2.0) -> list[FloatArray]:
    """Rings of a thread's profile without its lead: shallow ridges."""
    heights = np.arange(z_from, z_to, pitch / 2)
    depth = np.where(np.arange(len(heights)) % 2 == 0, 0.4 * pitch, 0.0)
    return [polar_ring(radius - d, z, RING_POINTS) for d, z in zip(depth, heights, strict=True)]


_BUILDERS: Mapping[str, tuple[Callable[[], Mesh], str]] = MappingProxyType(
    {
        "tube_fitting": (_tube_fitting, "stainless"),
        "hex_screw": (_hex_screw, "plated"),
        "eye_bolt": (_eye_bolt, "stainless"),
        "gear": (_gear, "stainless"),
    }
)
PART_NAMES = tuple(_BUILDERS)
