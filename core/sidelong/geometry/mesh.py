"""CAD models: reading, checking and simplifying them. The only caller of trimesh."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from sidelong.errors import MeshError, UnknownNameError
from sidelong.geometry.declared_symmetry import DeclaredSymmetry
from sidelong.geometry.mesh_repair import Shell, closed
from sidelong.geometry.point_sets import diameter_of, distinct_rows
from sidelong.geometry.symmetry import Symmetry
from sidelong.types import FloatArray, IntArray

METRES_PER_UNIT = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 25.4e-3}
SMALLEST_PART_M, LARGEST_PART_M = 0.5e-3, 5.0
"""Largest extents of a part a cell handles; a file outside them is in another unit than it says."""

MOST_TRIANGLES = 5_000_000
"""What still fits the memory of a cell's computer several times over."""

CLUSTERED_ABOVE = 200_000
"""Triangles above which a mesh is thinned before it is simplified."""

SMALLEST_FILL = 1e-12
"""Least volume relative to the cube of the largest extent: a wire of 1 m and 10 um still passes."""


@dataclass(frozen=True, eq=False)
class Part:
    """A part as its CAD file describes it, in its own object frame.

    Attributes
    ----------
    name
        Of the part, for messages and files.
    vertices_m
        (V, 3) metres.
    triangles
        (F, 3) vertex indices, counter-clockwise seen from outside.
    triangle_material
        (F,) index into ``materials``.
    materials
        Names of materials.
    declared_symmetry
        What the file beside the CAD file says of it; None where it says nothing.
    repairs
        What was done to close the mesh of the file, for messages; nothing where it was closed.
    """

    name: str
    vertices_m: FloatArray
    triangles: IntArray
    triangle_material: IntArray
    materials: tuple[str, ...]
    declared_symmetry: Symmetry | None = None
    repairs: tuple[str, ...] = ()

    @cached_property
    def symmetry(self) -> Symmetry:
        """The turns that map the part onto itself: as declared, else as found from the mesh."""
        if self.declared_symmetry is not None:
            return self.declared_symmetry
        # the search casts rays against parts, so it knows this module
        from sidelong.geometry.symmetry_search import find_symmetry

        return find_symmetry(self)

    @cached_property
    def triangle_normals(self) -> FloatArray:
        """(F, 3) outward unit normals; zero for a triangle without area."""
        corners = self.vertices_m[self.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)

    @cached_property
    def centre_m(self) -> FloatArray:
        """(3,) centre of the bounding box."""
        return (self.vertices_m.min(axis=0) + self.vertices_m.max(axis=0)) / 2

    @cached_property
    def diameter_m(self) -> float:
        """Largest distance between two vertices; see :func:`sidelong.geometry.point_sets.diameter_of`."""
        return diameter_of(self.vertices_m)


def part_from_arrays(
    name: str,
    vertices_m: FloatArray,
    triangles: IntArray,
    triangle_material: IntArray | None = None,
    materials: tuple[str, ...] = ("stainless",),
) -> Part:
    """Check a triangle mesh and return it as a part.

    Raises
    ------
    MeshError
        The mesh is empty or has more than ``MOST_TRIANGLES``, has coordinates that are not finite or triangles without
        vertex or material, is open (:func:`sidelong.geometry.mesh_repair.closed` closes small cracks and holes) or
        wound inconsistently, encloses no volume, or its largest extent lies outside ``SMALLEST_PART_M`` to
        ``LARGEST_PART_M``.

    Notes
    -----
    A mesh that is inside out as a whole is turned. Triangles without area stay, with their material and a zero normal.
    Several bodies, and surfaces that run through each other, are taken as they are: rays meet the outermost.
    """
    if len(triangles) == 0 or len(vertices_m) == 0:
        raise MeshError(f"{name}: the mesh is empty ({len(vertices_m)} vertices, {len(triangles)} triangles)")
    if len(triangles) > MOST_TRIANGLES:
        raise MeshError(f"{name}: the mesh has {len(triangles)} triangles, limit {MOST_TRIANGLES}: export it coarser")
    if not np.isfinite(vertices_m).all():
        raise MeshError(f"{name}: {int((~np.isfinite(vertices_m)).sum())} vertex coordinates are not finite")
    _check_triangles(name, triangles, len(vertices_m), triangle_material, len(materials))
    extent_m = float(np.ptp(vertices_m, axis=0).max())
    if not SMALLEST_PART_M <= extent_m <= LARGEST_PART_M:
        likely = "metres" if extent_m < SMALLEST_PART_M else "a smaller unit than declared"
        raise MeshError(
            f"{name}: the largest extent is {extent_m * 1e3:.4g} mm, limits {SMALLEST_PART_M * 1e3:g} to "
            f"{LARGEST_PART_M * 1e3:g} mm; the file seems to be in {likely}: declare its unit in the .json beside it"
        )
    if triangle_material is None:
        triangle_material = np.zeros(len(triangles), dtype=np.intp)
    shell = closed(name, Shell(np.asarray(vertices_m, dtype=np.float64), triangles, triangle_material))
    volume_m3 = _signed_volume(shell.vertices_m, shell.triangles)
    if abs(volume_m3) < SMALLEST_FILL * extent_m**3:
        raise MeshError(f"{name}: the mesh is flat, it encloses {abs(volume_m3) * 1e9:.3g} mm3")
    outward = shell.triangles if volume_m3 > 0 else np.ascontiguousarray(shell.triangles[:, ::-1])
    return Part(name, shell.vertices_m, outward, shell.material, materials, repairs=shell.repairs)


def _check_triangles(
    name: str, triangles: IntArray, vertex_count: int, triangle_material: IntArray | None, material_count: int
) -> None:
    if triangles.min() < 0 or triangles.max() >= vertex_count:
        raise MeshError(
            f"{name}: triangles refer to vertices {triangles.min()} to {triangles.max()}, the mesh has {vertex_count}"
        )
    if triangle_material is None:
        return
    if len(triangle_material) != len(triangles):
        raise MeshError(f"{name}: {len(triangle_material)} material indices for {len(triangles)} triangles")
    if triangle_material.min() < 0 or triangle_material.max() >= material_count:
        raise MeshError(
            f"{name}: material indices run from {triangle_material.min()} to {triangle_material.max()}, "
            f"there are {material_count} materials"
        )


def _signed_volume(vertices_m: FloatArray, triangles: IntArray) -> float:
    """Sum the tetrahedra from the first vertex to each triangle: positive where the triangles face outwards."""
    a, b, c = np.moveaxis(vertices_m[triangles] - vertices_m[0], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


def load_part(path: Path) -> Part:
    """Read a CAD file (STL, OBJ, PLY, OFF) and the material file of the same name beside it, if there is one.

    The material file is ``{"unit": "mm", "face_ranges": [[first, last, material], ...], "symmetry": {...}}``, last
    exclusive, in the face order of the file, all optional: without them the unit is mm, the material ``stainless``, and
    the symmetry what the mesh shows. See :class:`sidelong.geometry.declared_symmetry.DeclaredSymmetry`.

    Raises
    ------
    UnknownNameError
        The file does not exist.
    MeshError
        It cannot be read, the material file does not fit it, ``part_from_arrays`` refuses the mesh, or the mesh
        contradicts the declared symmetry.
    """
    import trimesh

    if not path.is_file():
        raise UnknownNameError(f"{path}: no such CAD file")
    try:
        # no merging on load: face_ranges count the faces of the file
        mesh: Any = trimesh.load_mesh(path, process=False)
        vertices, triangles = (
            np.asarray(mesh.vertices, dtype=np.float64),
            np.asarray(mesh.faces, dtype=np.intp),
        )
    except Exception as error:  # trimesh raises whatever its readers raise; all mean "unreadable"
        raise MeshError(f"{path}: cannot be read as a mesh: {error}") from error
    if len(triangles) == 0:
        raise MeshError(f"{path}: the mesh is empty (0 triangles)")
    about = _read_about(path.with_suffix(".json"))
    triangle_material, materials = _materials(about, len(triangles))
    _check_triangles(str(path), triangles, len(vertices), triangle_material, len(materials))
    first, index = distinct_rows(vertices)
    try:
        vertices_m = vertices[first] * about.metres_per_unit
        part = part_from_arrays(path.stem, vertices_m, index[triangles], triangle_material, materials)
        return part if about.symmetry is None else _declared(part, about)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


@dataclass(frozen=True)
class _About:
    """What the file beside a CAD file says."""

    path: Path
    metres_per_unit: float = METRES_PER_UNIT["mm"]
    face_ranges: tuple[tuple[int, int, str], ...] = ()
    symmetry: DeclaredSymmetry | None = None


def _read_about(path: Path) -> _About:
    if not path.is_file():
        return _About(path)
    try:
        content = json.loads(path.read_text())
        unit = str(content.get("unit", "mm"))
        ranges = tuple((int(a), int(b), str(name)) for a, b, name in content.get("face_ranges", []))
        symmetry = content.get("symmetry")
    except (ValueError, TypeError, AttributeError) as error:
        raise MeshError(f"{path}: cannot be read as a material file: {error}") from error
    if unit not in METRES_PER_UNIT:
        raise MeshError(f"{path}: unit is {unit!r}, known units are {', '.join(METRES_PER_UNIT)}")
    try:
        declared = None if symmetry is None else DeclaredSymmetry.model_validate(symmetry)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, ("symmetry", *first["loc"])))
        raise MeshError(f"{path}: {field} is {first['input']!r:.80}: {first['msg']}") from error
    return _About(path, METRES_PER_UNIT[unit], ranges, declared)


def _declared(part: Part, about: _About) -> Part:
    """Return the part with the symmetry that is declared for it. Raises MeshError where the mesh contradicts it."""
    from sidelong.geometry.symmetry_search import checked_symmetry, surface_moments

    assert about.symmetry is not None
    given = about.symmetry.centre
    centre_m = surface_moments(part)[0] if given is None else np.array(given) * about.metres_per_unit
    return replace(part, declared_symmetry=checked_symmetry(part, about.symmetry.symmetry(centre_m)))


def _materials(about: _About, triangle_count: int) -> tuple[IntArray, tuple[str, ...]]:
    """Return the material index per triangle, and material names."""
    path = about.path
    if not about.face_ranges:
        return np.zeros(triangle_count, dtype=np.intp), ("stainless",)
    materials = tuple(dict.fromkeys(name for _, _, name in about.face_ranges))
    index = np.full(triangle_count, -1, dtype=np.intp)
    for first, last, name in about.face_ranges:
        if not 0 <= first < last <= triangle_count:
            raise MeshError(f"{path}: face range {first}..{last} lies outside 0..{triangle_count}")
        if (index[first:last] >= 0).any():
            raise MeshError(f"{path}: face range {first}..{last} overlaps another")
        index[first:last] = materials.index(name)
    if (index < 0).any():
        raise MeshError(f"{path}: {int((index < 0).sum())} of {triangle_count} faces have no material")
    return index, materials


def simplified(part: Part, max_triangles: int) -> Part:
    """Return a coarser part for visibility rays (3,000 triangles: depth p99 error 0.024 mm); materials are dropped.

    Of more than ``CLUSTERED_ABOVE`` triangles, vertices that share a cell of a grid are merged first; about half of
    ``CLUSTERED_ABOVE`` triangles are left, whose corners are off by a fraction of a cell.
    """
    if len(part.triangles) <= max_triangles:
        return part
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(part.vertices_m),
        o3d.utility.Vector3iVector(part.triangles.astype(np.int32)),
    )
    if len(part.triangles) > CLUSTERED_ABOVE:
        # the decimation takes a minute for 2 million
        mesh = mesh.simplify_vertex_clustering(float(np.sqrt(4 * mesh.get_surface_area() / CLUSTERED_ABOVE)))
    mesh = mesh.simplify_quadric_decimation(max_triangles)
    triangles = np.asarray(mesh.triangles).astype(np.intp)
    return Part(
        part.name,
        np.asarray(mesh.vertices),
        triangles,
        np.zeros(len(triangles), dtype=np.intp),
        part.materials[:1],
        part.declared_symmetry,
    )
