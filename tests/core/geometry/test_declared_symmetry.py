"""The symmetry that the file beside a CAD file declares: how it is written, and what the mesh does not bear out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from sidelong.errors import MeshError
from sidelong.geometry.mesh import Part, load_part, simplified
from sidelong.geometry.transforms import rotation_about

make = trimesh.creation


def load(folder: Path, mesh: trimesh.Trimesh, symmetry: dict[str, Any], unit: str = "mm") -> Part:
    path = folder / "part.stl"
    mesh.export(path)
    path.with_suffix(".json").write_text(json.dumps({"unit": unit, "symmetry": symmetry}))
    return load_part(path)


def hexagon() -> trimesh.Trimesh:
    return make.cylinder(12.0, 20.0, sections=6)


def rod() -> trimesh.Trimesh:
    return make.cylinder(12.0, 60.0, sections=48)


@pytest.mark.parametrize(
    ("mesh", "declared", "turns"),
    [
        (hexagon(), {"none": True}, 1),
        (hexagon(), {"cyclic": 3, "axis": [0, 0, 2]}, 3),
        (hexagon(), {"cyclic": 6, "axis": [0, 0, -1]}, 6),
        (hexagon(), {"cyclic": 6, "axis": [0, 0, 1], "flip": [1, 0, 0.01]}, 12),
        (hexagon(), {"planes": [[0, 0, 3]]}, 1),
    ],
)
def test_what_is_declared_stands_against_what_the_mesh_shows(
    tmp_path: Path, mesh: trimesh.Trimesh, declared: dict[str, Any], turns: int
) -> None:
    symmetry = load(tmp_path, mesh, declared).symmetry
    assert len(symmetry.rotations) == turns
    assert symmetry.axis is None
    np.testing.assert_allclose(symmetry.rotations[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(symmetry.planes, [[0, 0, 1]] if "planes" in declared else np.zeros((0, 3)))


def test_a_cyclic_axis_turns_by_its_share_of_a_circle(tmp_path: Path) -> None:
    symmetry = load(tmp_path, hexagon(), {"cyclic": 6, "axis": [0, 0, 1]}).symmetry
    assert symmetry.angle_rad(rotation_about((0, 0, 1), np.pi / 3), np.eye(3)) == pytest.approx(0.0, abs=1e-9)
    assert symmetry.angle_rad(rotation_about((0, 0, 1), np.pi / 6), np.eye(3)) == pytest.approx(np.pi / 6)


def test_a_continuous_axis_with_and_without_a_flip(tmp_path: Path) -> None:
    plain = load(tmp_path, rod(), {"continuous": [0, 0, 4]}).symmetry
    np.testing.assert_allclose(plain.axis, [0, 0, 1])
    assert len(plain.rotations) == 1
    flipped = load(tmp_path, rod(), {"continuous": [0, 0, 1], "flip": [0, 1, 0]}).symmetry
    np.testing.assert_allclose(flipped.rotations[1], np.diag([-1, 1, -1]), atol=1e-12)


def test_a_ball_and_a_centre_in_the_unit_of_the_file(tmp_path: Path) -> None:
    ball = make.icosphere(3, 1.5).apply_translation((1.0, 2.0, 3.0))
    assert load(tmp_path, ball, {"ball": True}, "cm").symmetry.ball
    given = load(tmp_path, ball, {"ball": True, "centre": [1.0, 2.0, 3.0]}, "cm").symmetry
    np.testing.assert_allclose(given.centre_m, [0.01, 0.02, 0.03])
    with pytest.raises(MeshError, match="contradicts the declared symmetry"):
        load(tmp_path, ball, {"ball": True, "centre": [0.01, 0.02, 0.03]}, "cm")


def test_more_may_be_declared_than_is_found(tmp_path: Path) -> None:
    """A 10-gon is not round to the search (0.024 of its width), its owner may call it so; a hexagon is too far off."""
    ten = make.cylinder(12.0, 60.0, sections=10)
    path = tmp_path / "found.stl"
    ten.export(path)
    assert load_part(path).symmetry.axis is None
    assert load(tmp_path, ten, {"continuous": [0, 0, 1]}).symmetry.axis is not None
    with pytest.raises(
        MeshError, match=r"part\.stl: part: the mesh contradicts .* by 0\.06\d* of its width .* limit 0\.05"
    ):
        load(tmp_path, hexagon(), {"continuous": [0, 0, 1]})


@pytest.mark.parametrize(
    ("mesh", "declared"),
    [
        (hexagon(), {"cyclic": 4, "axis": [0, 0, 1]}),
        (hexagon(), {"cyclic": 6, "axis": [1, 0, 0]}),
        (make.cone(12.0, 40.0, sections=64), {"continuous": [0, 0, 1], "flip": [1, 0, 0]}),
        (make.cone(12.0, 40.0, sections=64), {"planes": [[0, 0, 1]]}),
        (make.box((10.0, 20.0, 30.0)), {"ball": True}),
    ],
    ids=["order", "axis", "flip", "plane", "ball"],
)
def test_what_the_mesh_contradicts_is_refused(tmp_path: Path, mesh: trimesh.Trimesh, declared: dict[str, Any]) -> None:
    with pytest.raises(MeshError, match=r"the mesh contradicts the declared symmetry by .*, limit 0\.05"):
        load(tmp_path, mesh, declared)


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        ({}, "one of none, ball, cyclic, continuous or planes is needed"),
        ({"none": True, "ball": True}, "one of none, ball, cyclic, continuous or planes is needed, got"),
        ({"none": False}, "symmetry.none is False"),
        ({"cyclic": 6}, "cyclic and axis belong together"),
        ({"cyclic": 1, "axis": [0, 0, 1]}, "symmetry.cyclic is 1: .* greater than or equal to 2"),
        ({"cyclic": 73, "axis": [0, 0, 1]}, "symmetry.cyclic is 73: .* less than or equal to 72"),
        ({"cyclic": 6, "axis": [0, 0]}, "symmetry.axis.2 is"),
        ({"cyclic": 6, "axis": [0, 0, 0]}, "has no direction"),
        ({"continuous": [0, 0, 1], "flip": [0, 1, 1]}, "is not square to the axis"),
        ({"none": True, "flip": [0, 1, 1]}, "flip needs cyclic or continuous"),
        ({"continous": [0, 0, 1]}, "symmetry.continous is .*Extra inputs are not permitted"),
        ({"continuous": [0, 0, float("inf")]}, "symmetry.continuous.2 is inf"),
        ([6], r"symmetry is \[6\]"),
        ("hexagon", "symmetry is 'hexagon'"),
    ],
)
def test_what_cannot_be_understood_is_named(tmp_path: Path, declared: Any, message: str) -> None:
    with pytest.raises(MeshError, match=rf"part\.json: {message}|part\.json: symmetry is .*{message}"):
        load(tmp_path, hexagon(), declared)


def test_a_coarser_part_keeps_what_was_declared(tmp_path: Path) -> None:
    part = load(tmp_path, make.icosphere(4, 20.0), {"none": True})
    assert simplified(part, 500).symmetry.trivial
