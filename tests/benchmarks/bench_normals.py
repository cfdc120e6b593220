"""Normals of a depth map: error against run time of both methods, all windows, and Open3D's principal components.

    python tests/benchmarks/bench_normals.py [--limits] [--repeats 3] [--each]

Surfaces with known normals before a ground plane, seen at 0.7 m: noise that grows as z^2, depth in steps of 0.03125
mm, holes. Errors are those of pixels on the surfaces (not the ground) that have depth; figures are means over the maps,
each counting the same. *Useful* is the share of those pixels that got a normal within 5 degrees of the true one: it
weighs what an estimator drops against what it gets wrong, and a star marks what nothing faster beats in it. Times are
per map of 640x512. ``--limits`` varies the limits on edges and residuals at the default window instead of method and
window.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sidelong.calibration.normals import NormalSettings, estimate_normals
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import transform
from sidelong.simulation.parts import simulated_part

CAMERA = PinholeCamera(640, 512, 1083.0, 1083.0, 319.5, 255.5)
DISTANCE_M = 0.7
GROUND_M = 0.74
NOISES_M = (0.02e-3, 0.1e-3, 0.3e-3)
STEP_M = 0.03125e-3

Estimator = Callable[[np.ndarray], np.ndarray]
Distance = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Case:
    """A depth map, the true normals (H, W, 3), and which pixels count (H, W)."""

    name: str
    noise_m: float
    depth_m: np.ndarray
    normals: np.ndarray
    counted: np.ndarray


def traced(distance: Distance) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sphere-trace a distance function before the ground; return depth, normals by central differences, and hits."""
    rays = CAMERA.pixel_rays()
    length = np.linalg.norm(rays, axis=-1)
    depth = np.full(length.shape, DISTANCE_M - 0.06)
    for _ in range(150):
        depth = np.minimum(depth + distance(rays * depth[..., None]) / length, GROUND_M)
    points = rays * depth[..., None]
    hit = (np.abs(distance(points)) < 1e-8) & (depth < GROUND_M)
    step = 1e-6
    gradient = np.stack(
        [distance(points + step * axis) - distance(points - step * axis) for axis in np.eye(3)], axis=-1
    )
    normals = np.where(hit[..., None], gradient / np.linalg.norm(gradient, axis=-1, keepdims=True), [0.0, 0.0, -1.0])
    return np.where(hit, depth, GROUND_M), normals, hit


def turned(angle_x: float, angle_y: float) -> np.ndarray:
    cx, sx, cy, sy = np.cos(angle_x), np.sin(angle_x), np.cos(angle_y), np.sin(angle_y)
    return np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]) @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])


def surfaces() -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return depth, normals and counted pixels of each surface."""
    centre = np.array([0.0, 0.0, DISTANCE_M])
    tilt = turned(0.5, 0.4)

    def sphere(p: np.ndarray) -> np.ndarray:
        return np.linalg.norm(p - centre, axis=-1) - 0.030

    def cylinder(p: np.ndarray) -> np.ndarray:
        q = (p - centre) @ tilt
        return np.linalg.norm(q[..., 1:], axis=-1) - 0.011

    def torus(p: np.ndarray) -> np.ndarray:
        q = (p - centre) @ tilt
        return np.hypot(np.linalg.norm(q[..., :2], axis=-1) - 0.025, q[..., 2]) - 0.008

    found = {name: traced(shape) for name, shape in (("sphere", sphere), ("cylinder", cylinder), ("torus", torus))}
    rays = CAMERA.pixel_rays()
    for degrees in (30, 65):
        angle = np.deg2rad(degrees)
        normal = np.array([np.sin(angle), 0.0, -np.cos(angle)])
        depth = (normal @ centre) / (rays @ normal)
        near = (depth > 0.5) & (depth < 1.0)
        found[f"plane {degrees}"] = np.where(near, depth, np.nan), np.broadcast_to(normal, rays.shape), near
    return found | {"fittings": cad_parts()}


def cad_parts() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    part = simulated_part("tube_fitting")
    poses = [
        transform(
            turned(0.9 + 0.7 * i, 0.4 * i) @ turned(0.2, 1.2), (-0.12 + 0.08 * (i % 4), -0.06 + 0.12 * (i // 4), 0.7)
        )
        for i in range(8)
    ]
    seen = RayScene([(part, pose) for pose in poses]).render(CAMERA, np.eye(4))
    hit = np.isfinite(seen.depth_m)
    normals = np.where(hit[..., None], seen.normals_scene, [0.0, 0.0, -1.0])
    return np.where(hit, seen.depth_m, GROUND_M), normals, hit


def cases() -> list[Case]:
    random = np.random.default_rng(5)
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    made: list[Case] = []
    for name, (depth, normals, hit) in surfaces().items():
        for noise_m in NOISES_M:
            measured = depth + noise_m * (depth / 0.7) ** 2 * random.standard_normal(depth.shape)
            measured = np.rint(measured / STEP_M) * STEP_M
            measured[random.random(depth.shape) < 0.03] = np.nan
            for row, column, radius in zip(*random.integers((0, 0, 2), (512, 640, 9), (60, 3)).T, strict=True):
                measured[(rows - row) ** 2 + (columns - column) ** 2 < radius**2] = np.nan
            made.append(Case(name, noise_m, measured, normals, hit & np.isfinite(measured)))
    return made


def ours(settings: NormalSettings) -> Estimator:
    return lambda depth_m: estimate_normals(depth_m, CAMERA, settings).normals_camera


def open3d_pca(neighbours: int) -> Estimator:
    import open3d as o3d

    rays = CAMERA.pixel_rays()

    def estimate(depth_m: np.ndarray) -> np.ndarray:
        present = np.isfinite(depth_m)
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(rays[present] * depth_m[present][:, None]))
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(neighbours))
        cloud.orient_normals_towards_camera_location(np.zeros(3))
        normals = np.full(rays.shape, np.nan)
        normals[present] = np.asarray(cloud.normals)
        return normals

    return estimate


USEFUL_DEG = 5.0


@dataclass(frozen=True)
class Row:
    """One line of the table; means over maps."""

    name: str
    median_deg: float
    rms_deg: float
    p95_deg: float
    share: float
    useful: float
    milliseconds: float


def angles_deg(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    across = np.linalg.norm(np.cross(found, true), axis=-1)
    return np.degrees(np.arctan2(across, np.sum(found * true, axis=-1)))


def measured_row(name: str, estimate: Estimator, tried: list[Case], repeats: int) -> Row:
    figures: list[tuple[float, ...]] = []
    for case in tried:
        times: list[float] = []
        found = np.empty(0)
        for _ in range(repeats):
            start = time.perf_counter()
            found = estimate(case.depth_m)
            times.append(time.perf_counter() - start)
        errors = angles_deg(found[case.counted], case.normals[case.counted])
        known = errors[np.isfinite(errors)]
        median, p95 = np.percentile(known, (50, 95)) if known.size else (np.nan, np.nan)
        rms = np.sqrt(np.mean(known**2)) if known.size else np.nan
        useful = np.sum(known < USEFUL_DEG) / errors.size
        figures.append((median, rms, p95, known.size / errors.size, useful, min(times) * 1e3))
    return Row(name, *np.nanmean(figures, axis=0).tolist())


def estimators(limits: bool) -> dict[str, Estimator]:
    if limits:
        tried = [
            (step, residual) for step in (0.5, 1.0, 2.0, 100.0) for residual in (0.025, 0.05, 0.1, 0.2, 1.0, 100.0)
        ]
        return {
            f"edge_step {step:g}, max_residual {residual:g}": ours(
                NormalSettings(edge_step=step, max_residual=residual)
            )
            for step, residual in tried
        }
    found = {
        f"inverse_depth {w}": ours(NormalSettings(method="inverse_depth", window_px=w)) for w in (3, 5, 7, 9, 11, 15)
    }
    found |= {f"pca {w}": ours(NormalSettings(method="pca", window_px=w)) for w in (3, 5, 7, 9)}
    return found | {f"Open3D PCA, {count} nearest": open3d_pca(count) for count in (9, 25, 49)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--limits", action="store_true")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--each", action="store_true", help="a table for each surface and noise as well")
    arguments = parser.parse_args()
    tried = cases()
    groups = {"all": tried}
    if arguments.each:
        groups |= {f"{case.name}, {case.noise_m * 1e3:g} mm": [case] for case in tried}
    for title, group in groups.items():
        rows = [measured_row(n, e, group, arguments.repeats) for n, e in estimators(arguments.limits).items()]
        sys.stdout.write(table(title, rows))


def table(title: str, rows: list[Row]) -> str:
    chosen = NormalSettings()
    defaults = (
        f"{chosen.method} {chosen.window_px}",
        f"edge_step {chosen.edge_step:g}, max_residual {chosen.max_residual:g}",
    )
    lines = [f"\n{title}\n{'':32} {'median':>7} {'rms':>7} {'p95':>7} {'normals':>8} {'useful':>7} {'ms':>8}\n"]
    for row in rows:
        beaten = any(other.milliseconds < row.milliseconds and other.useful > row.useful for other in rows)
        marks = ("" if beaten else " *") + (" default" if row.name in defaults else "")
        lines.append(
            f"{row.name:32} {row.median_deg:6.2f}° {row.rms_deg:6.2f}° {row.p95_deg:6.2f}° {row.share:8.1%} "
            f"{row.useful:7.1%} {row.milliseconds:8.1f}{marks}\n"
        )
    return "".join(lines)


if __name__ == "__main__":
    main()
