"""Files of a completed depth: pictures, arrays, points and mesh, as other programs read them."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import open3d as o3d
import pytest
import trimesh

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import look_at
from sidelong.types import CompletedDepth, FloatArray, PixelState
from sidelong_service.depth_files import (
    DEPTH_UNIT_M,
    LARGEST_PNG_DEPTH_M,
    LARGEST_PNG_SIGMA_M,
    SIGMA_UNIT_M,
    DepthFiles,
    depth_png,
    sigma_png,
    state_png,
)
from sidelong_service.ply import ply

CAMERA = PinholeCamera(24, 20, 200.0, 200.0, 11.0, 9.0)
SHAPE = CAMERA.height, CAMERA.width
BASE_T_CAMERA = look_at((0.4, -0.1, 0.6), (0.5, 0.0, 0.0))
NAN = np.nan

# --- pictures ---


def decoded(png: bytes, kind: type = np.uint16) -> FloatArray:
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.dtype == kind
    return picture.astype(np.float64)


def units(*depths_m: float) -> list[int]:
    return [int(value) for value in decoded(depth_png(np.array([depths_m]))).ravel()]


def test_depth_is_in_tenths_of_a_millimetre_and_rounded() -> None:
    assert DEPTH_UNIT_M == 1e-4
    assert units(0.7, 0.70004, 0.70006, 1e-4, 1.0) == [7000, 7000, 7001, 1, 10000]


def test_what_is_not_there_is_zero() -> None:
    assert units(np.nan, np.inf, -np.inf, 0.0, -0.3, 0.5) == [0, 0, 0, 0, 0, 5000]


def test_depth_beyond_the_range_is_missing_and_not_near() -> None:
    assert pytest.approx(6.5535) == LARGEST_PNG_DEPTH_M
    assert units(LARGEST_PNG_DEPTH_M, 6.55354, 6.5536, 6.6, 100.0) == [65535, 0, 0, 0, 0]


def test_all_missing_depth_is_a_picture_too() -> None:
    assert decoded(depth_png(np.full((3, 5), np.nan))).tolist() == np.zeros((3, 5)).tolist()


def test_rounding_is_never_more_than_half_a_unit() -> None:
    depth_m = np.random.default_rng(1).uniform(0.3, 6.5, (40, 50))
    np.testing.assert_allclose(decoded(depth_png(depth_m)) * DEPTH_UNIT_M, depth_m, atol=DEPTH_UNIT_M * 0.5001)


def test_sigma_is_in_micrometres_never_0_where_there_is_depth_and_never_wraps_around() -> None:
    assert SIGMA_UNIT_M == 1e-6
    assert pytest.approx(0.065535) == LARGEST_PNG_SIGMA_M
    sigma_m = np.array([[NAN, 0.0, 1e-8, 2.5e-4, 0.065535, 0.0656, 1.0, np.inf]])
    assert decoded(sigma_png(sigma_m)).ravel().tolist() == [0, 1, 1, 250, 65535, 65535, 65535, 65535]


def test_states_are_gray_values_of_eight_bits() -> None:
    states = np.array([list(PixelState)], dtype=np.uint8)
    assert decoded(state_png(states), np.uint8).ravel().tolist() == [0, 1, 2, 3, 4, 5]


# --- points and meshes, read by other programs ---


def written(folder: Path, content: bytes) -> Path:
    path = folder / "written.ply"
    path.write_bytes(content)
    return path


def directions(count: int, seed: int = 0) -> FloatArray:
    vectors = np.random.default_rng(seed).standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_a_cloud_says_what_its_bytes_are() -> None:
    points_m = np.array([[0.1, -0.2, 0.3], [1.0, 2.0, 3.0]])
    content = ply(points_m, directions(2), np.array([7, 255], np.uint8))
    header, _, body = content.partition(b"end_header\n")
    assert header.decode().splitlines() == [
        "ply", "format binary_little_endian 1.0", "comment metres, base frame", "element vertex 2",
        "property float x", "property float y", "property float z",
        "property float nx", "property float ny", "property float nz",
        "property uchar red", "property uchar green", "property uchar blue",
    ]  # fmt: skip
    assert len(body) == 2 * (6 * 4 + 3)


def test_open3d_and_trimesh_read_the_points_normals_and_gray_values_of_a_cloud(tmp_path: Path) -> None:
    points_m, normals = np.random.default_rng(2).normal(size=(100, 3)), directions(100)
    gray = np.arange(100, dtype=np.uint8)
    path = written(tmp_path, ply(points_m, normals, gray))
    cloud = o3d.io.read_point_cloud(str(path))
    np.testing.assert_allclose(np.asarray(cloud.points), points_m, atol=1e-6)
    np.testing.assert_allclose(np.asarray(cloud.normals), normals, atol=1e-6)
    np.testing.assert_allclose(np.asarray(cloud.colors), np.repeat(gray[:, None], 3, axis=1) / 255, atol=1e-9)
    other: Any = trimesh.load(path)
    np.testing.assert_allclose(other.vertices, points_m, atol=1e-6)
    assert np.array_equal(other.colors[:, :3], np.repeat(gray[:, None], 3, axis=1))


@pytest.mark.parametrize("coloured", [True, False])
def test_open3d_and_trimesh_read_a_mesh(tmp_path: Path, coloured: bool) -> None:
    points_m, normals = np.random.default_rng(2).normal(size=(30, 3)), directions(30)
    triangles = np.random.default_rng(3).permuted(np.tile(np.arange(30), (40, 1)), axis=1)[:, :3]
    gray = np.full(30, 200, np.uint8) if coloured else None
    path = written(tmp_path, ply(points_m, normals, gray, triangles))
    mesh = o3d.io.read_triangle_mesh(str(path))
    assert np.array_equal(np.asarray(mesh.triangles), triangles)
    np.testing.assert_allclose(np.asarray(mesh.vertices), points_m, atol=1e-6)
    np.testing.assert_allclose(np.asarray(mesh.vertex_normals), normals, atol=1e-6)
    assert mesh.has_vertex_colors() == coloured
    other: Any = trimesh.load(path, process=False)
    assert np.array_equal(other.faces, triangles)
    np.testing.assert_allclose(other.vertex_normals, normals, atol=1e-6)


def test_an_empty_cloud_and_an_empty_mesh_are_whole_files() -> None:
    nothing = np.empty((0, 3))
    cloud = ply(nothing, nothing, np.empty(0, np.uint8))
    assert b"element vertex 0\n" in cloud
    assert cloud.endswith(b"end_header\n")
    mesh = ply(nothing, nothing, None, np.empty((0, 3), np.intp))
    assert b"element face 0\n" in mesh
    assert mesh.endswith(b"end_header\n")


# --- all files of one depth ---


@pytest.fixture
def files() -> DepthFiles:
    """A plane 0.5 m away, measured on the left and completed on the right, with pixels of all other states in it."""
    state = np.full(SHAPE, PixelState.MEASURED, dtype=np.uint8)
    state[:, 12:] = PixelState.COMPLETED
    state[2, 2:5], state[5, 2:6], state[8, 2:7], state[11, 2:8] = (
        PixelState.CONTRADICTED, PixelState.DOUBTFUL, PixelState.MODELLED, PixelState.MISSING
    )  # fmt: skip
    depth_m = np.where(state == PixelState.MISSING, NAN, 0.5)
    source = np.where(state == PixelState.MEASURED, 0, 2)
    source[np.isin(state, (PixelState.MISSING, PixelState.MODELLED))] = -1
    depth = CompletedDepth(depth_m, np.where(np.isnan(depth_m), NAN, 3e-4), source, state)
    image = np.arange(state.size, dtype=np.uint8).reshape(SHAPE)
    return DepthFiles(depth, CAMERA, BASE_T_CAMERA, image, ("top", "side", "far"))


TRUSTED_PX = SHAPE[0] * SHAPE[1] - 3 - 4 - 5 - 6


def test_pictures_hold_what_is_trusted_and_the_state_of_each_pixel(files: DepthFiles) -> None:
    contents, trusted = files.contents(), files.depth.trusted
    assert trusted.sum() == TRUSTED_PX
    assert np.array_equal(decoded(contents["depth.png"]), np.where(trusted, 5000, 0))
    assert np.array_equal(decoded(contents["sigma.png"]), np.where(trusted, 300, 0))
    assert np.array_equal(decoded(contents["state.png"], np.uint8), files.depth.state)


def test_arrays_hold_everything_and_the_names_of_the_states(files: DepthFiles) -> None:
    with np.load(io.BytesIO(files.contents()["depth.npz"]), allow_pickle=False) as arrays:
        assert np.array_equal(arrays["depth_m"].view(np.uint64), files.depth.depth_m.view(np.uint64))
        np.testing.assert_allclose(arrays["sigma_m"], files.depth.sigma_m, rtol=1e-6)
        assert np.array_equal(arrays["source"], files.depth.source)
        assert np.array_equal(arrays["state"], files.depth.state)
        named = arrays["states"][arrays["state"]]
        assert (named[0, 0], named[0, 20], named[2, 2], named[5, 2], named[8, 2], named[11, 2]) == (
            "measured", "completed", "contradicted", "doubtful", "modelled", "missing"
        )  # fmt: skip
        assert arrays["views"].tolist() == ["top", "side", "far"]
        assert np.array_equal(arrays["base_T_camera"], BASE_T_CAMERA)
        assert arrays["K"].tolist() == [[200.0, 0.0, 11.0], [0.0, 200.0, 9.0], [0.0, 0.0, 1.0]]


def test_cloud_and_mesh_hold_what_is_trusted_in_the_base_frame(files: DepthFiles, tmp_path: Path) -> None:
    contents, trusted = files.contents(), files.depth.trusted
    expected_m = CAMERA.pixel_rays()[trusted] * 0.5 @ BASE_T_CAMERA[:3, :3].T + BASE_T_CAMERA[:3, 3]
    towards_camera = -BASE_T_CAMERA[:3, 2]
    cloud = o3d.io.read_point_cloud(str(written(tmp_path, contents["cloud.ply"])))
    np.testing.assert_allclose(np.asarray(cloud.points), expected_m, atol=1e-6)
    np.testing.assert_allclose(np.asarray(cloud.normals), np.tile(towards_camera, (TRUSTED_PX, 1)), atol=1e-6)
    np.testing.assert_allclose(np.asarray(cloud.colors)[:, 0] * 255, files.image[trusted], atol=1e-6)
    mesh = o3d.io.read_triangle_mesh(str(written(tmp_path, contents["mesh.ply"])))
    np.testing.assert_allclose(np.asarray(mesh.vertices), expected_m, atol=1e-6)
    mesh.compute_triangle_normals()
    np.testing.assert_allclose(
        np.asarray(mesh.triangle_normals), np.tile(towards_camera, (len(mesh.triangles), 1)), atol=1e-4
    )
    # a gap of n pixels in a row takes both triangles of n - 1 squares and one of the two at its ends, on either side
    whole = 2 * (SHAPE[0] - 1) * (SHAPE[1] - 1)
    assert len(mesh.triangles) == whole - sum(4 * n for n in (3, 4, 5, 6))


def test_the_legend_counts_states_and_says_what_the_files_hold(files: DepthFiles) -> None:
    legend = files.legend()
    measured_px = SHAPE[0] * 12 - 3 - 4 - 5 - 6
    assert legend["state_px"] == {
        "missing": 6, "measured": measured_px, "completed": SHAPE[0] * 12,
        "contradicted": 3, "doubtful": 4, "modelled": 5,
    }  # fmt: skip
    assert legend["state_png"] == {state.name.lower(): int(state) for state in PixelState}
    for name in ("depth_png", "sigma_png", "cloud_ply", "mesh_ply"):
        assert list(legend[name]["holds"]) == ["measured", "completed"]
    assert legend["cloud_ply"]["points"] == TRUSTED_PX
    assert legend["depth_png"]["beyond_largest_px"] == 0


def test_depth_beyond_the_picture_s_range_is_counted(files: DepthFiles) -> None:
    files.depth.depth_m[0, :3] = 6.6
    files.depth.depth_m[2, 2] = 6.6  # contradicted: it is in no picture anyway
    assert files.legend()["depth_png"]["beyond_largest_px"] == 3


def test_a_depth_of_which_nothing_is_trusted_gives_whole_files() -> None:
    nothing = np.full(SHAPE, NAN)
    states = np.zeros(SHAPE, np.uint8)
    depth = CompletedDepth(nothing, nothing, np.full(SHAPE, -1), states)
    contents = DepthFiles(depth, CAMERA, BASE_T_CAMERA, np.zeros(SHAPE, np.uint8), ("top",)).contents()
    assert not decoded(contents["depth.png"]).any()
    assert b"element vertex 0\n" in contents["cloud.ply"]
    assert b"element face 0\n" in contents["mesh.ply"]
