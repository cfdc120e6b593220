"""A bin on a table, and parts that lie in it: each on a face it rests on, none touching another."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.errors import SettingsError
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.transforms import rotation_about, transform, transform_points
from sidelong.simulation.lofting import joined, loft, rectangle_ring
from sidelong.types import FloatArray

GAP_M = 1.5e-3
"""Least distance between the footprints of two parts, and of a part and a wall."""
TRIES_PER_PART = 400
"""Random places tried for one part before the bin counts as full."""


class Bin(BaseModel):
    """An open box, its floor at z = 0 and centred on the z axis of its own frame, on a table."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    length_m: FiniteFloat = Field(default=0.30, gt=0.02, le=2.0, description="inner length along x")
    width_m: FiniteFloat = Field(default=0.22, gt=0.02, le=2.0, description="inner width along y")
    height_m: FiniteFloat = Field(default=0.04, gt=0.0, le=1.0, description="height of the walls above the floor")
    wall_m: FiniteFloat = Field(default=0.004, ge=0.0005, le=0.1, description="thickness of walls and floor")
    table_m: FiniteFloat = Field(default=1.4, gt=0.05, le=4.0, description="side of the square table the bin stands on")
    material: str = Field(default="matte", description="of bin and table: matte, or printed for a strong texture")

    def part(self) -> Part:
        """Return box and table as one part (two closed shells that share a plane nobody sees)."""
        outer = (self.length_m + 2 * self.wall_m, self.width_m + 2 * self.wall_m)
        inner = (self.length_m, self.width_m)
        box = [
            rectangle_ring(*outer, -self.wall_m),
            rectangle_ring(*outer, self.height_m),
            rectangle_ring(*inner, self.height_m),
            rectangle_ring(*inner, 0.0),
        ]
        table = [rectangle_ring(self.table_m, self.table_m, z) for z in (-self.wall_m - 0.02, -self.wall_m)]
        return part_from_arrays("bin", *joined([loft(box), loft(table)]), materials=(self.material,))


def fill_bin(part: Part, count: int, seed: int, base_T_bin: FloatArray, bin_: Bin) -> list[FloatArray]:
    """Lay parts into a bin, side by side.

    Each rests on a face of its convex hull above which its centre of volume stands, chosen as often as a thrown part
    would land on it. Footprints (convex outlines seen from above) keep ``GAP_M`` from each other and from the walls,
    so the parts themselves cannot touch.

    Parameters
    ----------
    part
        The part.
    count
        How many, at least 0.
    seed
        Same seed, same bin.
    base_T_bin
        (4, 4) pose of the bin in the base frame.
    bin_
        Its sizes.

    Returns
    -------
    ``base_T_object`` (4, 4) of each part.

    Raises
    ------
    SettingsError
        The count is negative, or that many do not fit.
    """
    if count < 0:
        raise SettingsError(f"bin count: is {count}, needs at least 0")
    rng = np.random.default_rng(seed)
    resting, likelihood = resting_rotations(part)
    hull_m = _hull_vertices(part)
    half_m = np.array([bin_.length_m, bin_.width_m]) / 2 - GAP_M
    footprints: list[FloatArray] = []
    bin_T_objects: list[FloatArray] = []
    tries = 0
    while len(bin_T_objects) < count:
        if tries == TRIES_PER_PART:
            raise SettingsError(
                f"bin count: {count} x {part.name} do not fit side by side into "
                f"{bin_.length_m:g} x {bin_.width_m:g} m, {len(bin_T_objects)} did (seed {seed})"
            )
        tries += 1
        bin_T_object = _dropped(resting[rng.choice(len(resting), p=likelihood)], hull_m, half_m, rng)
        if bin_T_object is None:
            continue
        footprint = convex_outline(transform_points(bin_T_object, hull_m)[:, :2])
        if all(outline_distance(footprint, other) >= GAP_M for other in footprints):
            footprints.append(footprint)
            bin_T_objects.append(bin_T_object)
            tries = 0
    return [base_T_bin @ bin_T_object for bin_T_object in bin_T_objects]


def resting_rotations(part: Part) -> tuple[FloatArray, FloatArray]:
    """Return the rotations (P, 3, 3) in which a part rests on a plane z = const, and how likely each is (P,).

    A face of the convex hull carries the part if the centre of volume lies above it; its likelihood is the share of
    directions, seen from that centre, that meet it.
    """
    import trimesh

    mesh = trimesh.Trimesh(part.vertices_m, part.triangles, process=False)
    hull = mesh.convex_hull
    centre = np.asarray(mesh.center_mass, dtype=np.float64)
    corners = np.asarray(hull.vertices, dtype=np.float64)[np.asarray(hull.faces)] - centre
    normals = np.asarray(hull.face_normals, dtype=np.float64)
    solid_angles = _solid_angles(corners)
    faces = np.unique(np.round(normals, 3), axis=0, return_inverse=True)[1].reshape(-1)
    rotations: list[FloatArray] = []
    likelihood: list[float] = []
    for face in range(int(faces.max()) + 1):
        mine = faces == face
        normal = normals[mine][0]
        if _above(corners[mine], normal):
            rotations.append(_turning_down(normal))
            likelihood.append(float(solid_angles[mine].sum()))
    return np.array(rotations), np.array(likelihood) / np.sum(likelihood)


def convex_outline(points_m: FloatArray) -> FloatArray:
    """Return the corners (C, 2) of the convex hull of points (N, 2), counter-clockwise."""
    from scipy.spatial import ConvexHull

    return np.asarray(points_m[ConvexHull(points_m).vertices], dtype=np.float64)


def outline_distance(first: FloatArray, second: FloatArray) -> float:
    """Return a lower bound of the distance of two convex outlines; 0 or less where they overlap.

    The largest gap along the edge normals of either: exact where an edge faces the other outline.
    """
    return max(_largest_gap(first, second), _largest_gap(second, first))


def _largest_gap(outline: FloatArray, other: FloatArray) -> float:
    edges = np.roll(outline, -1, axis=0) - outline
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=-1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return float(((other @ normals.T).min(axis=0) - np.einsum("ij,ij->i", outline, normals)).max())


def _dropped(
    rotation: FloatArray, hull_m: FloatArray, half_m: FloatArray, rng: np.random.Generator
) -> FloatArray | None:
    """Turn a resting part at random and put it somewhere between the walls; None where it is too long for that."""
    turned = rotation_about((0, 0, 1), rng.uniform(0.0, 2.0 * np.pi)) @ rotation
    points = hull_m @ turned.T
    low, high = -half_m - points[:, :2].min(axis=0), half_m - points[:, :2].max(axis=0)
    place = rng.uniform(0.0, 1.0, 2)
    if (low > high).any():
        return None
    return transform(turned, (*(low + place * (high - low)), -points[:, 2].min()))


def _hull_vertices(part: Part) -> FloatArray:
    from scipy.spatial import ConvexHull

    return part.vertices_m[ConvexHull(part.vertices_m).vertices]


def _solid_angles(corners: FloatArray) -> FloatArray:
    """Solid angles (F,) of triangles (F, 3, 3) seen from the origin (Van Oosterom and Strackee)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    dot_ab, dot_bc, dot_ca = (np.einsum("ij,ij->i", x, y) for x, y in ((a, b), (b, c), (c, a)))
    denominator = la * lb * lc + dot_ab * lc + dot_bc * la + dot_ca * lb
    return 2.0 * np.abs(np.arctan2(np.einsum("ij,ij->i", a, np.cross(b, c)), denominator))


def _above(corners: FloatArray, normal: FloatArray) -> bool:
    """Say whether the origin, dropped along the normal, lands on one of the coplanar triangles (F, 3, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    foot = normal * (corners[0, 0] @ normal)
    sides = [np.cross(end - start, foot - start) @ normal for start, end in ((a, b), (b, c), (c, a))]
    return bool((np.min(sides, axis=0) >= -1e-12).any())


def _turning_down(normal: FloatArray) -> FloatArray:
    """Return a rotation (3, 3) that takes ``normal`` to -z."""
    axis = np.cross(normal, (0.0, 0.0, -1.0))
    angle_rad = np.arctan2(np.linalg.norm(axis), -normal[2])
    return rotation_about(axis if np.linalg.norm(axis) > 1e-9 else (1.0, 0.0, 0.0), float(angle_rad))
