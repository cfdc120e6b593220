"""Fusion: error against run time of the engines, honesty of sigma, arm errors, wires, outliers.

    python tests/benchmarks/bench_fusion.py [--scenes tube_fitting gear hex_screw wires] [--seeds 0,1] [--engines warp]

Each scene is a heap of parts (or wires of 1 mm) on the ground, seen by 1280x1024 px at 1083 px focal length from above
and then from three sides. Depth is rendered and made worse as a stereo matcher does: noise in disparity (the default
:class:`DepthNoise`, neighbours alike within 3 px), 0.5 % of the pixels anywhere within 20 mm, patches without depth (30
% of the reference, 15 % of the others). Poses are exact, or with ``arm`` as far off as an arm is (0.3 mm, 0.05 degrees
each).

*Recovered*: of the holes whose surface some further view measured to 1 mm, the share within 2 mm of the truth, and the
rms of those. *Beyond*: share of all completed pixels more than 2 mm off. *z*: standard deviation of error over sigma
and share within 1.96, of all that are within 2 mm, and of all. *Contradicted*: share of the reference's outliers
(beyond 5 mm) that are marked where a view could tell, and how many good depths are marked in a million. Times are
medians for one view (milliseconds), and of laying out the reference; a peer's include ray casting the reference view
after each.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from sidelong.fusion.completion import Completion
from sidelong.fusion.settings import EngineName, FusionSettings, RegistrationSettings
from sidelong.geometry.camera_model import StereoRig
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import invert, look_at, rotation_about, transform, transform_points
from sidelong.physics.depth_noise import DepthNoise
from sidelong.simulation.bin import Bin
from sidelong.simulation.heap import heap
from sidelong.simulation.parts import simulated_part
from sidelong.simulation.rig import rig_for
from sidelong.types import BoolArray, FloatArray, Frame, PixelState, Projector, View

REFERENCE = look_at((0.0, 0.0, 0.72), (0.0, 0.0, 0.0))
NOISE = DepthNoise()
ALIKE_PX = 1.5
OUTLIER_SHARE, OUTLIER_REACH_M = 5e-3, 20e-3
ARM_SHIFT_M, ARM_TURN_RAD = 0.3e-3, 0.9e-3
PARTS = 16
WIRES = 24


@dataclass(frozen=True, eq=False)
class Shot:
    """A depth map, its truth, where it is, where the arm says it is, and which pixels are outliers."""

    truth_m: FloatArray
    depth_m: FloatArray
    base_T_camera: FloatArray
    said: FloatArray
    outlier: BoolArray

    def frame(self, name: str) -> Frame:
        blank = np.zeros(self.depth_m.shape, dtype=np.uint8)
        return Frame(View(name, self.said), blank, None, self.depth_m, Projector.DOTS, 0.01)


def cylinder(name: str, radius_m: float, length_m: float) -> Part:
    import trimesh

    mesh = trimesh.creation.cylinder(radius=radius_m, height=length_m, sections=24)
    return part_from_arrays(name, np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.intp))


def scene_of(name: str, seed: int) -> RayScene:
    """Return a heap of parts, or wires across the bin, on a ground plate."""
    import trimesh

    box = trimesh.creation.box((0.7, 0.7, 0.02))
    ground = part_from_arrays("ground", np.asarray(box.vertices), np.asarray(box.faces, dtype=np.intp))
    posed = [(ground, transform(np.eye(3), (0.0, 0.0, -0.01)))]
    rng = np.random.default_rng(seed)
    if name == "wires":
        wire = cylinder("wire", 0.5e-3, 0.12)
        for _ in range(WIRES):
            lying = rotation_about((0, 0, 1), rng.uniform(0, np.pi)) @ rotation_about(
                (0, 1, 0), np.pi / 2 - rng.uniform(0, 0.5)
            )
            posed.append((wire, transform(lying, (*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.04, 0.06)))))
        return RayScene(posed)
    part = simulated_part(name)
    posed += [(part, pose) for pose in heap(part, PARTS, seed, np.eye(4), Bin())]
    return RayScene(posed)


def patches(shape: tuple[int, int], share: float, rng: np.random.Generator) -> BoolArray:
    """Return smooth patches that cover this share of an image."""
    smooth = gaussian_filter(rng.normal(size=shape), 16.0)
    return smooth > np.quantile(smooth, 1.0 - share)


def shoot(
    scene: RayScene, rig: StereoRig, base_T_camera: FloatArray, arm: float, rng: np.random.Generator, lost: float
) -> Shot:
    """Take one depth map."""
    truth_m = scene.render(rig.left, base_T_camera).depth_m
    noise = gaussian_filter(rng.normal(size=truth_m.shape), ALIKE_PX)
    depth_m = np.where(patches(truth_m.shape, lost, rng), np.nan, truth_m)
    depth_m = depth_m + NOISE.sigma_m(depth_m, rig) * noise / noise.std()
    outlier = rng.random(truth_m.shape) < OUTLIER_SHARE
    depth_m = depth_m + outlier * rng.uniform(-OUTLIER_REACH_M, OUTLIER_REACH_M, truth_m.shape)
    said = base_T_camera.copy()
    turn = rng.normal(size=3) * arm * ARM_TURN_RAD / np.sqrt(3)
    if arm:
        said[:3, :3] = rotation_about(turn, float(np.linalg.norm(turn))) @ said[:3, :3]
        said[:3, 3] += rng.normal(size=3) * arm * ARM_SHIFT_M / np.sqrt(3)
    return Shot(truth_m, depth_m, base_T_camera, said, outlier & np.isfinite(depth_m))


def shots(name: str, seed: int, rig: StereoRig, arm: float) -> tuple[RayScene, list[Shot]]:
    """Return the reference from above and three views from the sides."""
    scene, rng = scene_of(name, seed), np.random.default_rng(seed + 1000)
    turns = rng.uniform(0, 2 * np.pi) + np.array([0.0, 2.1, 4.2])
    sides = [
        look_at((r * np.cos(a), r * np.sin(a), z), (0.0, 0.0, 0.01), roll_rad=roll)
        for a, r, z, roll in zip(turns, (0.25, 0.35, 0.42), (0.65, 0.6, 0.5), rng.uniform(-1, 1, 3), strict=True)
    ]
    taken = [shoot(scene, rig, REFERENCE, arm, rng, 0.3)]
    return scene, [*taken, *(shoot(scene, rig, side, arm, rng, 0.15) for side in sides)]


def well_measured(reference: Shot, other: Shot, rig: StereoRig) -> BoolArray:
    """Say which surface points of the reference another view measured, to 1 mm, on all four pixels around it."""
    points = transform_points(
        invert(other.base_T_camera) @ reference.base_T_camera, rig.left.pixel_rays() * reference.truth_m[..., None]
    )
    uv = rig.left.project(points)
    well = rig.left.contains(uv) & rig.left.contains(uv + 1.0) & rig.left.contains(uv - 1.0)
    column, row = np.floor(uv[well]).astype(np.intp).T
    around = np.stack([other.depth_m[row + j, column + i] for j in (0, 1) for i in (0, 1)])
    well[well] = (np.abs(around - points[..., 2][well]) < 1e-3).all(axis=0)
    return well


def settings_of(engine: EngineName, registered: bool) -> FusionSettings:
    return FusionSettings(engine=engine, registration=RegistrationSettings() if registered else None)


def row_of(rig: StereoRig, taken: list[Shot], settings: FusionSettings, thin: BoolArray | None) -> dict[str, float]:
    """Fuse and judge one scene."""
    reference, others = taken[0], taken[1:]
    began = time.perf_counter()
    completion = Completion(reference.frame("top"), rig, settings)
    laid_out_s = time.perf_counter() - began
    times_s: list[float] = []
    refused = 0
    for index, other in enumerate(others):
        began = time.perf_counter()
        fused = completion.add(other.frame(f"side{index}"))
        times_s.append(time.perf_counter() - began)
        refused += fused.refused is not None
    depth = completion.depth
    error_m = depth.depth_m - reference.truth_m
    holes = np.isnan(reference.depth_m) & np.isfinite(reference.truth_m)
    well = np.logical_or.reduce([well_measured(reference, other, rig) for other in others])
    asked = holes & well if thin is None else holes & well & thin
    within = np.abs(error_m) < 2e-3
    completed = holes & (depth.state == PixelState.COMPLETED)
    z = (error_m / depth.sigma_m)[completed]
    inner = z[within[completed]]
    wrong = (np.abs(reference.depth_m - reference.truth_m) > 5e-3) & well
    good = (np.abs(reference.depth_m - reference.truth_m) < 1e-3) & (depth.state != PixelState.MISSING)
    marked = depth.state == PixelState.CONTRADICTED
    kept = np.isfinite(reference.depth_m)
    return {
        "recovered": 100 * float(within[asked].mean()),
        "rms mm": 1e3 * float(np.sqrt((error_m[asked & within] ** 2).mean())),
        "beyond %": 100 * float((~within[completed]).mean()),
        "z": float(inner.std()),
        "cover %": 100 * float((np.abs(inner) < 1.96).mean()),
        "z all": float(z.std()),
        "cover all %": 100 * float((np.abs(z) < 1.96).mean()),
        "contra %": 100 * float(marked[wrong].mean()) if wrong.any() else float("nan"),
        "false ppm": 1e6 * float(marked[good].mean()),
        "changed": float((depth.depth_m[kept] != reference.depth_m[kept]).sum()),
        "refused": float(refused),
        "lay ms": 1e3 * laid_out_s,
        "view ms": 1e3 * float(np.median(times_s)),
    }


def rows(arguments: argparse.Namespace) -> Iterator[tuple[str, dict[str, float]]]:
    rig = rig_for(1280, 1024)
    for name in arguments.scenes:
        for arm in arguments.arm:
            for engine in arguments.engines:
                for registered in (True, False) if arm else (True,):
                    found: list[dict[str, float]] = []
                    for seed in arguments.seeds:
                        _, taken = shots(name, seed, rig, arm)
                        thin = taken[0].truth_m < 0.71 if name == "wires" else None
                        settings = settings_of(EngineName(engine), registered)
                        if not found:
                            row_of(rig, taken, settings, thin)  # compiles, and fills caches
                        found.append(row_of(rig, taken, settings, thin))
                    label = f"{name:13s} arm {arm:g} {engine}{'' if registered else ' unregistered'}"
                    yield label, {key: float(np.median([row[key] for row in found])) for key in found[0]}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["tube_fitting", "gear", "hex_screw", "wires"])
    parser.add_argument("--seeds", type=lambda text: [int(each) for each in text.split(",")], default=[0, 1])
    parser.add_argument("--engines", nargs="+", default=["warp"])
    parser.add_argument("--arm", type=lambda text: [float(each) for each in text.split(",")], default=[0.0, 1.0])
    arguments = parser.parse_args()
    head = True
    for label, row in rows(arguments):
        if head:
            sys.stdout.write(f"{'':44s}" + "".join(f"{key:>12s}" for key in row) + "\n")
            head = False
        sys.stdout.write(f"{label:44s}" + "".join(f"{value:12.3f}" for value in row.values()) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
