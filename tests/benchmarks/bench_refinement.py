"""Refinement of poses by depth: error against run time of our registration and Open3D's, basin, and honesty.

    python tests/benchmarks/bench_refinement.py [--parts tube_fitting hex_screw eye_bolt gear] [--scenes 6]

Each scene is one part in a random pose at 0.7 m before the ground it touches, seen at 1083 px focal length; depth has
0.1 mm noise, and a share of outliers spread over the part's diameter.

*Error against run time*: ten hypotheses 5 degrees and 3 mm off, all registered to the same 4,000 points near the part.
ADI, the mean distance to the nearest vertex, is that of the converged (below 0.1 mm; the share stands beside it). Times
are for an object with all ten; "processor" sums both cores, and says more on a shared machine. Open3D's point-to-plane
with Tukey's kernel gets CAD samples with CAD normals as its target, at kernels 2 and then 0.6 mm (its correspondences
see neither lines of sight nor fronts and backs). "look-up" replaces exact nearest points by the grid in all steps,
"samples" by the nearest of 10,000 surface samples (scipy's tree).

*Whole stage*: ``Refiner.refine`` with the same ten hypotheses, whose duplicates are merged before the last steps.

*Basin*: share of hypotheses that come within 0.1 mm, by how far off they start.

*NEES*: squared error in units of the covariance, for noise shared by 10x10 px as the settings assume, where all
directions are determined; 6 is right, more is overconfident.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from sidelong.detection import registration as module
from sidelong.detection.refinement import DepthView, Refiner
from sidelong.detection.refinement_settings import RefinementSettings
from sidelong.detection.registration import Cloud, Registration
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import invert, transform, transform_points
from sidelong.simulation.parts import simulated_part
from sidelong.types import DetectedObject, Hypothesis

FOCAL_PX, DISTANCE_M, NOISE_M = 1083.0, 0.7, 0.1e-3
HYPOTHESES, POINTS = 10, 4000
CONVERGED_M = 0.1e-3
STARTS = ((3, 2e-3), (5, 3e-3), (10, 5e-3), (15, 5e-3), (15, 8e-3), (25, 5e-3))

Solver = Callable[[np.ndarray, Cloud], np.ndarray]


@dataclass(frozen=True, eq=False)
class Scene:
    """True pose (4, 4), and what was measured as a map (H, W) and as points near the part."""

    true: np.ndarray
    camera: PinholeCamera
    depth_m: np.ndarray
    cloud: Cloud


def scene(part: Part, rng: np.random.Generator, outliers: float, ground: bool = True, window_px: int = 1) -> Scene:
    pose = transform(Rotation.random(random_state=rng).as_matrix(), (0.0, 0.0, DISTANCE_M))
    pose[:3, 3] -= pose[:3, :3] @ part.centre_m
    size = int(1.4 * part.diameter_m * FOCAL_PX / DISTANCE_M)
    camera = PinholeCamera(size, size, FOCAL_PX, FOCAL_PX, (size - 1) / 2, (size - 1) / 2)
    depth_m = RayScene([(part, pose)]).render(camera, np.eye(4)).depth_m
    if ground:
        depth_m = np.where(np.isnan(depth_m), transform_points(pose, part.vertices_m)[:, 2].max(), depth_m)
    depth_m += NOISE_M * window_px * uniform_filter(rng.standard_normal(depth_m.shape), window_px)
    wrong = rng.random(depth_m.shape) < outliers
    depth_m[wrong] += rng.uniform(-0.5, 0.5, wrong.sum()) * part.diameter_m
    row, column = np.nonzero(np.isfinite(depth_m))
    order = rng.permutation(len(row))
    row, column = row[order], column[order]
    points = camera.rays(column, row) * depth_m[row, column][:, None]
    near = np.linalg.norm(points - (0.0, 0.0, DISTANCE_M), axis=1) < 0.65 * part.diameter_m
    near &= np.cumsum(near) <= POINTS
    points, cell = points[near], ((row // 10) * size + column // 10)[near].astype(np.intp)
    towards = -points / np.linalg.norm(points, axis=1, keepdims=True)
    return Scene(pose, camera, depth_m, Cloud(points, towards, np.zeros(len(points), dtype=np.intp), cell))


def starts(true: np.ndarray, part: Part, turn_deg: float, shift_m: float, rng: np.random.Generator) -> np.ndarray:
    axes = rng.standard_normal((2, HYPOTHESES, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    poses = np.repeat(true[None], HYPOTHESES, axis=0)
    poses[:, :3, :3] = Rotation.from_rotvec(np.deg2rad(turn_deg) * axes[0]).as_matrix() @ true[:3, :3]
    poses[:, :3, 3] = transform_points(true, part.centre_m) + shift_m * axes[1] - poses[:, :3, :3] @ part.centre_m
    return poses


def errors_m(found: np.ndarray, true: np.ndarray, part: Part) -> np.ndarray:
    """ADI of poses (K, 4, 4): symmetric parts may end in any of their equivalent poses."""
    tree = cKDTree(part.vertices_m)
    some = part.vertices_m[:: max(1, len(part.vertices_m) // 1500)]
    return np.array([tree.query(transform_points(invert(true) @ pose, some))[0].mean() for pose in found])


class Samples:
    """Nearest of many samples of the surface."""

    def __init__(self, part: Part, count: int = 10_000) -> None:
        self.points, self.normals = sampled(part, count)
        self._tree = cKDTree(self.points)

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        _, index = self._tree.query(points, workers=2)
        return self.points[index], self.normals[index]


def sampled(part: Part, count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    corners = part.vertices_m[part.triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    triangle = rng.choice(len(areas), count, p=areas / areas.sum())
    share = rng.dirichlet((1, 1, 1), count)
    return (corners[triangle] * share[..., None]).sum(axis=1), part.triangle_normals[triangle]


def ours(part: Part, **changed: float) -> Solver:
    registration = Registration(part, RefinementSettings.model_validate(changed))
    return lambda poses, cloud: registration.settle(registration.approach(poses, cloud), cloud, 1).poses


class _Replaced(Registration):
    """Asks another structure for nearest points wherever the product asks the triangles."""

    def __init__(self, part: Part, surface: module.Surface | None) -> None:
        super().__init__(part, RefinementSettings())
        self._other = surface or self._grid

    def _planes(self, poses, cloud, drawn, surface, kernel_m):
        return super()._planes(poses, cloud, drawn, self._other, kernel_m)


def replaced(part: Part, surface: module.Surface | None) -> Solver:
    registration = _Replaced(part, surface)
    return lambda poses, cloud: registration.settle(registration.approach(poses, cloud), cloud, 1).poses


def open3d_icp(part: Part) -> Solver:
    import open3d as o3d

    icp = o3d.pipelines.registration
    target = o3d.geometry.PointCloud()
    points, normals = sampled(part, 20_000)
    target.points, target.normals = o3d.utility.Vector3dVector(points), o3d.utility.Vector3dVector(normals)

    def solve(poses: np.ndarray, cloud: Cloud) -> np.ndarray:
        source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
        found = []
        for pose in poses:
            object_T_camera = invert(pose)
            for kernel_m, reach_m in ((2e-3, 6e-3), (0.6e-3, 2e-3)):
                estimation = icp.TransformationEstimationPointToPlane(icp.TukeyLoss(kernel_m))
                object_T_camera = icp.registration_icp(
                    source, target, reach_m, object_T_camera, estimation,
                    icp.ICPConvergenceCriteria(max_iteration=30),
                ).transformation  # fmt: skip
            found.append(invert(object_T_camera))
        return np.stack(found)

    return solve


def solvers(part: Part) -> dict[str, Solver]:
    return {
        "ours": ours(part),
        "ours, 500 fine points": ours(part, fine_points=500),
        "ours, 4000 fine points": ours(part, fine_points=4000),
        "ours, 12 coarse steps": ours(part, coarse_steps=12),
        "ours, 48 coarse steps": ours(part, coarse_steps=48),
        "ours, wide kernel 0.08": ours(part, wide_kernel=0.08),
        "ours, wide kernel 0.25": ours(part, wide_kernel=0.25),
        "look-up": replaced(part, None),
        "samples": replaced(part, Samples(part)),
        "Open3D point-to-plane": open3d_icp(part),
    }


def error_against_time(parts: dict[str, Part], scenes: int, outliers: float) -> str:
    found: dict[str, list[np.ndarray]] = {}
    took: dict[str, list[tuple[float, float]]] = {}
    for part in parts.values():
        tried = solvers(part)
        rng = np.random.default_rng(0)
        for _ in range(scenes):
            made = scene(part, rng, outliers)
            poses = starts(made.true, part, 5.0, 3e-3, rng)
            for name, solve in tried.items():
                wall, processor = time.perf_counter(), time.process_time()
                result = solve(poses, made.cloud)
                times = time.perf_counter() - wall, time.process_time() - processor
                took.setdefault(name, []).append(times)
                found.setdefault(name, []).append(errors_m(result, made.true, part))
    lines = [f"\n{outliers:.0%} outliers\n{'':26} {'median':>10} {'p95':>10} {'converged':>10} {'wall':>9} processor\n"]
    for name, errors in found.items():
        each = np.concatenate(errors)
        good = each[each < CONVERGED_M] * 1e3
        median, p95 = np.percentile(good, (50, 95)) if good.size else (np.nan, np.nan)
        wall, processor = np.median(took[name], axis=0) * 1e3
        lines.append(
            f"{name:26} {median:7.4f} mm {p95:7.4f} mm {good.size / each.size:10.0%} {wall:6.0f} ms"
            f" {processor:6.0f} ms\n"
        )
    return "".join(lines)


def whole_stage(parts: dict[str, Part], scenes: int) -> str:
    lines = [f"\nwhole stage, 33% outliers\n{'':16} {'median':>10} {'p95':>10} {'wall':>9} processor\n"]
    for name, part in parts.items():
        rng = np.random.default_rng(3)
        errors, took = [], []
        for _ in range(scenes):
            made = scene(part, rng, 0.33)
            poses = starts(made.true, part, 5.0, 3e-3, rng)
            refiner = Refiner(part, made.camera, RefinementSettings())
            refiner.add(DepthView("reference", made.depth_m, np.eye(4)))
            detected = DetectedObject(tuple(Hypothesis(pose, 70.0, 1 / HYPOTHESES) for pose in poses))
            wall, processor = time.perf_counter(), time.process_time()
            (found,) = refiner.refine((detected,))
            took.append((time.perf_counter() - wall, time.process_time() - processor))
            errors.append(errors_m(found.hypotheses[0].camera_T_object[None], made.true, part)[0] * 1e3)
        median, p95 = np.percentile(errors, (50, 95))
        wall, processor = np.median(took, axis=0) * 1e3
        lines.append(f"{name:16} {median:7.4f} mm {p95:7.4f} mm {wall:6.0f} ms {processor:6.0f} ms\n")
    return "".join(lines)


def basin(parts: dict[str, Part], scenes: int) -> str:
    lines = [f"\nbasin, 33% outliers\n{'':16}" + "".join(f"{f'{d} deg {m * 1e3:g} mm':>14}" for d, m in STARTS) + "\n"]
    for name, part in parts.items():
        for title, solve in (("", ours(part)), (" Open3D", open3d_icp(part))):
            rng = np.random.default_rng(1)
            shares = []
            for turn_deg, shift_m in STARTS:
                errors = []
                for _ in range(scenes):
                    made = scene(part, rng, 0.33)
                    poses = starts(made.true, part, turn_deg, shift_m, rng)
                    errors.append(errors_m(solve(poses, made.cloud), made.true, part))
                shares.append(float(np.mean(np.concatenate(errors) < CONVERGED_M)))
            lines.append(f"{name[:9] + title:16}" + "".join(f"{share:14.0%}" for share in shares) + "\n")
    return "".join(lines)


def honesty(parts: dict[str, Part], scenes: int) -> str:
    lines = [
        f"\nNEES over {scenes} scenes without ground, 6 is right\n"
        f"{'':16} {'mean':>6} {'median':>7} {'determined':>11}\n"
    ]
    for name, part in parts.items():
        registration = Registration(part, RefinementSettings())
        rng = np.random.default_rng(2)
        figures = []
        for _ in range(scenes):
            made = scene(part, rng, 0.0, ground=False, window_px=10)
            start = starts(made.true, part, 0.3, 0.2e-3, rng)[:1]
            found = registration.settle(start, made.cloud, 1)
            pose, covariance = found.poses[0], found.covariance[0]
            if np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]) > np.deg2rad(3) or not found.determined[0]:
                continue
            turn = Rotation.from_matrix(made.true[:3, :3] @ pose[:3, :3].T).as_rotvec()
            shift = transform_points(made.true, part.centre_m) - transform_points(pose, part.centre_m)
            error = np.concatenate([turn, shift])
            figures.append(float(error @ np.linalg.solve(covariance, error)))
        mean, median = (np.mean(figures), np.median(figures)) if figures else (np.nan, np.nan)
        lines.append(f"{name:16} {mean:6.1f} {median:7.1f} {len(figures) / scenes:11.0%}\n")
    return "".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", default=["tube_fitting", "hex_screw", "eye_bolt", "gear"])
    parser.add_argument("--scenes", type=int, default=6)
    arguments = parser.parse_args()
    parts = {name: simulated_part(name) for name in arguments.parts}
    for outliers in (0.0, 0.33):
        sys.stdout.write(error_against_time(parts, arguments.scenes, outliers))
        sys.stdout.flush()
    sys.stdout.write(whole_stage(parts, arguments.scenes))
    sys.stdout.write(basin(parts, arguments.scenes))
    sys.stdout.write(honesty(parts, 10 * arguments.scenes))


if __name__ == "__main__":
    main()
