"""Both engines of the fusion and Open3D's VoxelBlockGrid on the same frames: error, time, memory.

    python tests/benchmarks/bench_fusion_engines.py [--scenes tube_fitting gear wires] [--outliers 0 0.01]
        [--alike 0 1.5] [--recorded FOLDER] [--settings '{"behind_m": 0.0015}']

Heaps of parts, or wires of 1 mm, in a region of 340x340x100 mm are seen at 1280x1024 px and 1083 px focal length from
above and from three sides. Depth is rendered; it gets noise (``--alike``: how far, in pixels, neighbours err alike),
patches without depth (30 % of each view) and outliers anywhere within 20 mm. With ``--recorded`` a scene of a recorded
data set comes after them: its first view as reference, three others, and its true depth.

Poses are exact, and engines stand alone: no registration, nothing refused. Depth outside the region is taken away
first: Open3D has no region. *warp* and *volume* are this project's; VoxelBlockGrid has the volume's voxels, in blocks
of a side and with a truncation as named; "render" of the warp is to settle on one depth for each hole. Each engine runs
in a process of its own, after a first run on the reference alone. *MB* is how much its memory grows at most beyond that
process; *add* the median time of a further view, *cpu* that of all processors together, which other work disturbs less;
*render* the time to see the reference's holes. *Asked* are holes within the region that another view measured to 1 mm
on all four pixels around (of wires: pixels on wires, on the nearest); *back* the share of those within 2 mm of the
truth, and rms, median and 95th percentile of their errors. *Beyond*: share of all completed holes more than 2 mm off;
*open*: of those left, and *left* the share still back, when what lies behind 12 mm of space nobody saw is left out.
*z*: standard deviation of error over sigma of completed holes within 2 mm, *95 %*: share of them within 1.96.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from sidelong.fusion.engine import PosedDepth
from sidelong.fusion.settings import FusionSettings
from sidelong.fusion.volume.region import Corners, region_of
from sidelong.fusion.volume.settings import VolumeSettings
from sidelong.fusion.volume.volume import Volume
from sidelong.fusion.warping.engine import WarpEngine
from sidelong.geometry.camera_model import PinholeCamera, StereoRig
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import invert, look_at, rotation_about, transform, transform_points
from sidelong.physics.depth_noise import DepthNoise
from sidelong.recorded.dataset import Dataset
from sidelong.simulation.bin import Bin
from sidelong.simulation.heap import heap
from sidelong.simulation.parts import simulated_part
from sidelong.simulation.rig import rig_for
from sidelong.types import BoolArray, FloatArray

CAMERA = PinholeCamera(1280, 1024, 1083.0, 1083.0, 636.4, 509.4)
RIG = StereoRig(CAMERA, CAMERA, rig_for().baseline_m, rig_for().projector)
REGION: Corners = ((-0.17, -0.17, -0.01), (0.17, 0.17, 0.09))
POSES = (
    look_at((0.0, 0.0, 0.7), (0.0, 0.0, 0.0)),
    *(
        look_at((0.35 * np.cos(turn), 0.35 * np.sin(turn), 0.6), (0.0, 0.0, 0.0), roll_rad=roll)
        for turn, roll in ((0.3, 0.0), (2.2, 1.0), (4.1, -2.0))
    ),
)
NOISE = DepthNoise(disparity_px=0.03, slope_px=0.15, rim_px=0.1)
"""0.14 mm on the ground."""
LOST_SHARE = 0.3
PARTS, WIRES = 20, 24
UNSEEN_M = 0.012


@dataclass(frozen=True, eq=False)
class Case:
    """Depth maps of some views with the noise's deviation; the first is the reference, whose truth is known.

    ``asked`` (H, W): which of the reference's holes are asked for if another view measured them; ``thin``: what is
    asked for is a pixel wide or two.
    """

    name: str
    rig: StereoRig
    region_m: Corners
    poses: tuple[FloatArray, ...]
    depths_m: tuple[FloatArray, ...]
    sigmas_m: tuple[FloatArray, ...]
    truth_m: FloatArray
    asked: BoolArray
    thin: bool

    @property
    def holes(self) -> BoolArray:
        return ~np.isfinite(self.depths_m[0])


@dataclass(frozen=True, eq=False)
class Run:
    """What an engine gave for the holes, the time of each view and of the rendering, and the growth of memory."""

    depth_m: FloatArray
    sigma_m: FloatArray
    unseen_m: FloatArray
    add_s: tuple[float, ...]
    cpu_s: tuple[float, ...]
    render_s: float
    megabytes: float


def scene_of(name: str, seed: int) -> RayScene:
    import trimesh

    def part(named: str, mesh: trimesh.Trimesh) -> Part:
        return part_from_arrays(named, np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.intp))

    posed = [(part("ground", trimesh.creation.box((0.6, 0.6, 0.02))), transform(np.eye(3), (0.0, 0.0, -0.01)))]
    if name != "wires":
        shape = simulated_part(name)
        return RayScene(posed + [(shape, pose) for pose in heap(shape, PARTS, seed, np.eye(4), Bin())])
    random = np.random.default_rng(seed)
    wire = part("wire", trimesh.creation.cylinder(radius=0.5e-3, height=0.12, sections=24))
    for _ in range(WIRES):
        lying = rotation_about((0, 1, 0), np.pi / 2 - random.uniform(0, 0.5))
        turn = rotation_about((0, 0, 1), random.uniform(0, np.pi))
        posed.append((wire, transform(turn @ lying, (*random.uniform(-0.1, 0.1, 2), random.uniform(0.04, 0.06)))))
    return RayScene(posed)


def simulated(name: str, outliers: float, alike_px: float, seed: int) -> Case:
    scene, random = scene_of(name, seed), np.random.default_rng(seed)
    truths = [scene.render(CAMERA, pose).depth_m for pose in POSES]
    taken = [captured(truth_m, outliers, alike_px, random) for truth_m in truths]
    points = transform_points(POSES[0], CAMERA.pixel_rays() * truths[0][..., None])
    within = inside(points, REGION, 0.002)
    case = Case(
        f"{name}, {outliers:.0%} outliers, alike {alike_px:g} px",
        RIG,
        REGION,
        POSES,
        tuple(depth_m for depth_m, _ in taken),
        tuple(sigma_m for _, sigma_m in taken),
        truths[0],
        within & (points[..., 2] > 0.005) if name == "wires" else within,
        name == "wires",
    )
    return cut(case)


def captured(
    truth_m: FloatArray, outliers: float, alike_px: float, random: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    smooth = gaussian_filter(random.normal(size=truth_m.shape), 16.0)
    depth_m = np.where(smooth > np.quantile(smooth, 1 - LOST_SHARE), np.nan, truth_m)
    sigma_m = NOISE.sigma_m(depth_m, RIG).astype(np.float64)
    noise = gaussian_filter(random.normal(size=truth_m.shape), alike_px)
    depth_m = depth_m + sigma_m * noise / noise.std()
    stray = random.random(truth_m.shape) < outliers
    return depth_m + stray * random.uniform(-0.02, 0.02, truth_m.shape), sigma_m


def recorded(folder: Path) -> Case:
    data = Dataset(folder)
    scene = data.scene(data.objects[0], 1)
    views = scene.views()
    rig, chosen = data.rig, [views[index] for index in (0, 5, 10, 15)]
    truth_m = scene.true_depth_m(chosen[0].name)
    assert truth_m is not None
    depths = tuple(scene.depth_m(view.name) for view in chosen)
    parts = RayScene([(data.part(data.objects[0]), pose) for pose in scene.base_T_objects])
    on_parts = np.isfinite(parts.render(rig.left, chosen[0].base_T_camera).depth_m)
    low, high = region_of(np.where(on_parts, truth_m, np.nan), rig.left, chosen[0].base_T_camera, 0.02)
    case = Case(
        f"{folder.name}, on the parts",
        rig,
        (low, high),
        tuple(view.base_T_camera for view in chosen),
        depths,
        tuple(DepthNoise().sigma_m(depth_m, rig).astype(np.float64) for depth_m in depths),
        truth_m,
        on_parts & np.isfinite(truth_m),
        False,
    )
    return cut(case)


def inside(points: FloatArray, region_m: Corners, margin_m: float) -> BoolArray:
    low, high = np.array(region_m)
    return ((points > low + margin_m) & (points < high - margin_m)).all(axis=-1)


def cut(case: Case) -> Case:
    """Take away depth outside the region."""
    rays = case.rig.left.pixel_rays()
    depths: list[FloatArray] = []
    for depth_m, pose in zip(case.depths_m, case.poses, strict=True):
        within = inside(transform_points(pose, rays * depth_m[..., None]), case.region_m, 0.0)
        depths.append(np.where(within, depth_m, np.nan))
    # what the reference measured outside is no hole
    return replace(case, depths_m=tuple(depths), asked=case.asked & ~np.isfinite(case.depths_m[0]))


def shown(case: Case) -> BoolArray:
    """Say which surface points of the reference a further view measured, to 1 mm, on all pixels around them."""
    camera, found = case.rig.left, np.zeros(case.truth_m.shape, dtype=bool)
    points = transform_points(case.poses[0], camera.pixel_rays() * case.truth_m[..., None])
    for depth_m, pose in zip(case.depths_m[1:], case.poses[1:], strict=True):
        points_view = transform_points(invert(pose), points)
        uv = camera.project(points_view)
        seen = camera.contains(uv)
        around = [(0.0, 0.0)] if case.thin else [(i, j) for i in (-0.5, 0.5) for j in (-0.5, 0.5)]
        for shift in around:
            column, row = np.clip(np.rint(uv[seen] + shift).astype(np.intp), 0, (camera.width - 1, camera.height - 1)).T
            seen[seen] = np.abs(depth_m[row, column] - points_view[..., 2][seen]) < 1e-3
        found |= seen
    return found


class OurEngine:
    def __init__(self, case: Case, settings: VolumeSettings) -> None:
        self._volume, self._case = Volume(case.rig.left, case.region_m, settings), case

    def add(self, index: int) -> None:
        case = self._case
        self._volume.add(case.depths_m[index], case.sigmas_m[index], case.poses[index], index)

    def render(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        seen = self._volume.render(self._case.poses[0], self._case.holes)
        return seen.depth_m, seen.sigma_m, seen.unseen_m


class Warping:
    def __init__(self, case: Case) -> None:
        self._engine, self._case = WarpEngine(case.rig.left, case.holes, FusionSettings()), case

    def add(self, index: int) -> None:
        if index == 0:  # the reference asks, and is not asked
            return
        case = self._case
        depth_m, sigma_m = (each[index].astype(np.float32) for each in (case.depths_m, case.sigmas_m))
        pose = invert(case.poses[0]) @ case.poses[index]
        self._engine.add(PosedDepth(index, depth_m, sigma_m, pose, np.zeros((6, 6))))

    def render(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        estimate, holes = self._engine.estimate(), self._case.holes
        depth_m, sigma_m, unseen_m = (np.full(holes.shape, np.nan) for _ in range(3))
        depth_m[holes], sigma_m[holes] = estimate.depth_m, estimate.sigma_m
        return depth_m, sigma_m, unseen_m


class VoxelBlockGrid:
    """Open3D's, of signed distance and weight, with its ray casting."""

    def __init__(self, case: Case, voxel_m: float, resolution: int, truncation: float) -> None:
        import open3d as o3d

        self._o3d: Any = o3d
        core = o3d.core
        blocks = 400_000 if resolution == 8 else 80_000
        self._grid: Any = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), voxel_m, resolution, blocks // 8
        )
        camera = case.rig.left
        self._intrinsic = core.Tensor(np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]]))
        self._case, self._truncation = case, truncation

    def _pose(self, index: int) -> Any:
        return self._o3d.core.Tensor(invert(self._case.poses[index]))

    def add(self, index: int) -> None:
        depth = np.nan_to_num(self._case.depths_m[index]).astype(np.float32)
        image = self._o3d.t.geometry.Image(self._o3d.core.Tensor(np.ascontiguousarray(depth[..., None])))
        blocks = self._grid.compute_unique_block_coordinates(
            image, self._intrinsic, self._pose(index), 1.0, 3.0, self._truncation
        )
        self._grid.integrate(blocks, image, self._intrinsic, self._pose(index), 1.0, 3.0, self._truncation)

    def render(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        camera = self._case.rig.left
        blocks = self._grid.hashmap().key_tensor()[self._grid.hashmap().active_buf_indices().to(self._o3d.core.int64)]
        seen = self._grid.ray_cast(
            blocks, self._intrinsic, self._pose(0), camera.width, camera.height, ["depth"], 1.0, 0.1, 3.0, 0.5,
            self._truncation, 8,
        )  # fmt: skip
        depth_m = seen["depth"].numpy()[..., 0].astype(np.float64)
        depth_m[~(depth_m > 0) | ~self._case.holes] = np.nan
        unknown = np.full(depth_m.shape, np.nan)
        return depth_m, unknown, unknown


def run(make: Callable[[Case], Any], case: Case) -> Run:
    """Run an engine here: once on the reference alone, to compile and to fill caches, then on everything."""
    engine = make(case)
    engine.add(0)
    engine.render()
    del engine
    before_kb = memory_kb("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # forget the highest memory so far
    engine, add_s, cpu_s = make(case), list[float](), list[float]()
    for index in range(len(case.poses)):
        start, cpu = time.perf_counter(), time.process_time()
        engine.add(index)
        add_s.append(time.perf_counter() - start)
        cpu_s.append(time.process_time() - cpu)
    start = time.perf_counter()
    depth_m, sigma_m, unseen_m = engine.render()
    render_s = time.perf_counter() - start
    return Run(depth_m, sigma_m, unseen_m, tuple(add_s), tuple(cpu_s), render_s, (memory_kb("VmHWM") - before_kb) / 1e3)


def memory_kb(what: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(what))


@dataclass(frozen=True)
class Ours:
    settings: VolumeSettings

    def __call__(self, case: Case) -> OurEngine:
        return OurEngine(case, self.settings)


@dataclass(frozen=True)
class Peer:
    voxel_m: float
    resolution: int
    truncation: float

    def __call__(self, case: Case) -> VoxelBlockGrid:
        return VoxelBlockGrid(case, self.voxel_m, self.resolution, self.truncation)


HEAD = (
    f"{'':30} {'add ms':>7} {'cpu ms':>7} {'render':>7} {'MB':>5} {'asked':>7} {'back':>6} {'rms mm':>7} "
    f"{'median':>7} {'p95':>7} {'beyond':>7} {'open':>7} {'left':>6} {'z':>5} {'95 %':>6}\n"
)


def row(name: str, done: Run, case: Case, asked: BoolArray) -> str:
    error_m = done.depth_m - case.truth_m
    back = np.abs(error_m[asked]) < 2e-3
    errors_mm = np.abs(error_m[asked][back]) * 1e3
    completed = case.asked & np.isfinite(error_m)
    beyond = np.abs(error_m) > 2e-3
    open_ = completed & ~(done.unseen_m > UNSEEN_M)
    z = (error_m / done.sigma_m)[completed & ~beyond]
    median, p95 = np.percentile(errors_mm, (50, 95)) if errors_mm.size else (np.nan, np.nan)
    honest = f"{z.std():5.2f} {(np.abs(z) < 1.96).mean():6.1%}" if np.isfinite(z).any() else f"{'':5} {'':6}"
    return (
        f"{name:30} {np.median(done.add_s[1:]) * 1e3:7.0f} {np.median(done.cpu_s[1:]) * 1e3:7.0f} "
        f"{done.render_s * 1e3:7.0f} "
        f"{done.megabytes:5.0f} {asked.sum():7d} {back.mean():6.1%} {np.sqrt(np.mean(errors_mm**2)):7.3f} "
        f"{median:7.3f} {p95:7.3f} {beyond[completed].mean():7.2%} {beyond[open_].mean():7.2%} "
        f"{(back & open_[asked]).mean():6.1%} {honest}\n"
    )


def report(case: Case, engines: dict[str, Callable[[Case], Any]]) -> None:
    asked = case.asked & shown(case)
    sys.stdout.write(f"\n{case.name}\n{HEAD}")
    context = multiprocessing.get_context("spawn")
    for name, make in engines.items():
        with context.Pool(1) as alone:
            done = alone.apply(run, (make, case))
        sys.stdout.write(row(name, done, case, asked))
        sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=["tube_fitting", "gear", "wires"])
    parser.add_argument("--outliers", nargs="*", type=float, default=[0.0, 0.01])
    parser.add_argument("--alike", nargs="*", type=float, default=[0.0])
    parser.add_argument("--recorded", type=Path)
    parser.add_argument("--settings", type=json.loads, default={})
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args(arguments)
    settings = VolumeSettings.model_validate(chosen.settings)
    engines: dict[str, Callable[[Case], Any]] = {"warp": Warping, "volume": Ours(settings)} | {
        f"VoxelBlockGrid {resolution}^3, {truncation:g} voxels": Peer(settings.voxel_m, resolution, truncation)
        for resolution, truncation in ((16, 8.0), (8, 8.0), (8, 4.0))
    }
    for name in chosen.scenes:
        for outliers in chosen.outliers:
            for alike_px in chosen.alike:
                report(simulated(name, outliers, alike_px, chosen.seed), engines)
    if chosen.recorded:
        report(recorded(chosen.recorded), engines)


if __name__ == "__main__":
    main()
