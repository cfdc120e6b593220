"""The volumetric engine: depth maps laid into voxels, and what a camera would see of them.

Each voxel keeps the mean of the signed distances that views gave it, weighted by their information (Curless and Levoy,
"A volumetric method for building complex models from range images", 1996), and how likely it is no outlier: the mean of
a Beta distribution over its inlier ratio, as in Vogiatzis and Hernandez, "Video-based, real-time multi-view stereo"
(2011), and Dong et al., "PSDF Fusion" (2018). Those update both together, measurement by measurement, each weighed by
what the ones before made likely, so their result depends on the order. Here a vote is whole: a view that puts a surface
near the voxel speaks for it, one that saw through it against it. All that is kept are sums and a minimum, over what
each view says by itself, so the order does not matter but for rounding. What disagrees within the band is averaged, not
voted out.

A view updates a voxel once, from the pixel it falls on, however many pixels there are to a voxel. The distance is that
to the plane through the pixel and those neighbours that are not across a depth edge, so slopes and what lies between
pixel centres add no error, and no depth is interpolated between two surfaces.
"""

from __future__ import annotations

import math

import numpy as np

from sidelong.errors import DepthError, ImageError, SettingsError
from sidelong.fusion.volume.grid import BLOCK, BYTES_PER_CHUNK, BYTES_PER_SLOT, CHUNK, MOST_COUNTED, Grid, empty_grid
from sidelong.fusion.volume.kernels import Band, integrate, see_through, touch
from sidelong.fusion.volume.march import VolumeView, march
from sidelong.fusion.volume.mesh import triangulated
from sidelong.fusion.volume.region import Corners
from sidelong.fusion.volume.settings import VolumeSettings
from sidelong.fusion.volume.surfels import BYTES_PER_PX, NEAREST_M, Surfels, surfels_of
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import invert, transform, transform_points, validated_transform
from sidelong.kernels import strips
from sidelong.types import BoolArray, FloatArray, IntArray, RealArray, SceneSurface

SHEETS = 3
"""Layers of blocks that a region must have room for across its largest face."""
LAST_STEP = MOST_COUNTED - 1
MARGIN_PX = 4
"""Pixels around those that show the region, so that they have their neighbours."""


class Volume:
    """Voxels of a region of the base frame that learn from depth maps how far the nearest surface is.

    Parameters
    ----------
    camera
        Of all depth maps and renderings.
    region_m
        Lowest and highest corner in the base frame.
    settings
        Voxels, bands and limits.

    Raises
    ------
    SettingsError
        The region is empty, inverted or not finite, or would need more than ``max_bytes``; nothing was allocated.
    """

    def __init__(self, camera: PinholeCamera, region_m: Corners, settings: VolumeSettings | None = None) -> None:
        self._settings = settings or VolumeSettings()
        self._camera = camera
        low, chunks = _chunks_of(region_m, self._settings.voxel_m)
        self._fixed_bytes = math.prod(chunks) * BYTES_PER_CHUNK
        self._fixed_bytes += camera.width * camera.height * BYTES_PER_PX
        _check_memory(chunks, self._fixed_bytes, self._settings)
        self._grid: Grid = empty_grid(chunks, (self._settings.max_bytes - self._fixed_bytes) // BYTES_PER_SLOT)
        self._used = 0
        # voxel centres are at whole numbers
        self._base_T_grid = transform(np.eye(3) * self._settings.voxel_m, low + self._settings.voxel_m / 2)
        self._grid_T_base = transform(
            np.eye(3) / self._settings.voxel_m, -self._base_T_grid[:3, 3] / self._settings.voxel_m
        )

    @property
    def nbytes(self) -> int:
        """Bytes in use, with those of the work on one frame; never more than ``max_bytes``."""
        return self._fixed_bytes + self._used * BYTES_PER_SLOT

    def add(self, depth_m: RealArray, sigma_m: RealArray, base_T_camera: FloatArray, step: int) -> None:
        """Lay a depth map into the volume; the order of the depth maps does not matter.

        Parameters
        ----------
        depth_m
            (H, W) along the optical axis; what is not a positive, finite length counts as missing.
        sigma_m
            (H, W) standard deviation of each.
        base_T_camera
            (4, 4).
        step
            Number of the capture, from 0.

        Raises
        ------
        ImageError
            A map does not have the camera's size.
        PoseError
            The pose is no rigid motion.
        SettingsError
            The step is out of range.
        DepthError
            The surfaces of this depth map would need more than ``max_bytes``; the volume is as it was.
        """
        base_T_camera = validated_transform(base_T_camera, f"step {step}")
        if not 0 <= step <= LAST_STEP:
            raise SettingsError(f"step: is {step}, limits 0 to {LAST_STEP}")
        self._check_size(depth_m, "depth map")
        self._check_size(sigma_m, "sigma")
        rows, columns = self._window(invert(base_T_camera))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return
        with np.errstate(over="ignore"):
            maps = [np.ascontiguousarray(image[rows, columns], dtype=np.float32) for image in (depth_m, sigma_m)]
        lens = [self._camera.fx, self._camera.fy, self._camera.cx - columns.start, self._camera.cy - rows.start]
        surfels = surfels_of(
            maps[0],
            maps[1],
            np.array(lens, dtype=np.float32),
            self._settings.voxel_m,
            self._settings.max_incidence_rad,
        )
        self._lay(surfels, base_T_camera, step)

    def _lay(self, surfels: Surfels, base_T_camera: FloatArray, step: int) -> None:
        touched = self._touched(surfels, base_T_camera)
        self._allocate(touched)
        camera_T_grid = (invert(base_T_camera) @ self._base_T_grid)[:3].astype(np.float32)
        grid, band = self._grid, self._band
        strips(
            lambda first, last: integrate(grid, touched, surfels, camera_T_grid, band, step, first, last), len(touched)
        )
        strips(
            lambda first, last: see_through(grid, surfels, camera_T_grid, band, first, last), grid.chunks_through.size
        )

    def _window(self, camera_T_base: FloatArray) -> tuple[slice, slice]:
        """Return the rows and columns that may show the region, all of them where it reaches behind the camera."""
        size = np.array([self._camera.width, self._camera.height])
        ends = np.stack([np.full(3, -0.5), np.array(self._grid.slots.shape) * BLOCK - 0.5])
        corners = np.stack(np.meshgrid(*ends.T), axis=-1).reshape(-1, 3)
        points_camera = transform_points(camera_T_base @ self._base_T_grid, corners)
        low, high = np.zeros(2), size.astype(np.float64)
        if (points_camera[:, 2] > NEAREST_M).all():
            uv = self._camera.project(points_camera)
            low, high = np.floor(uv.min(axis=0)) - MARGIN_PX, np.ceil(uv.max(axis=0)) + 1 + MARGIN_PX
        first, last = np.clip(low, 0, size).astype(int).tolist(), np.clip(high, 0, size).astype(int).tolist()
        return slice(first[1], last[1]), slice(first[0], last[0])

    @property
    def _band(self) -> Band:
        lengths = np.array([self._settings.front_m, self._settings.behind_m]) / self._settings.voxel_m
        front, behind = lengths.astype(np.float32)
        return Band(front, behind, np.float32(self._settings.voxel_m))

    def _touched(self, surfels: Surfels, base_T_camera: FloatArray) -> IntArray:
        """Return the blocks (N, 3) that a depth map says something of: it alone decides, not those before it."""
        grid_T_camera = (self._grid_T_base @ base_T_camera)[:3].astype(np.float32)

        def marked(first: int, last: int) -> BoolArray:
            marks = np.zeros(self._grid.slots.shape, dtype=np.bool_)
            touch(surfels, grid_T_camera, self._band, marks, first, last)
            return marks

        return np.argwhere(np.logical_or.reduce(strips(marked, len(surfels.planes))))

    def _allocate(self, touched: IntArray) -> None:
        """Give blocks slots where they have none yet."""
        fresh = touched[self._grid.slots[tuple(touched.T)] < 0]
        if self._used + len(fresh) > len(self._grid.sums):
            needed = self.nbytes + len(fresh) * BYTES_PER_SLOT
            raise DepthError(
                f"volume: the surfaces of this depth map need {needed} bytes, limit max_bytes "
                f"{self._settings.max_bytes}: shrink region_m or enlarge voxel_m"
            )
        self._grid.slots[tuple(fresh.T)] = np.arange(self._used, self._used + len(fresh), dtype=np.int32)
        self._used += len(fresh)

    def _check_size(self, image: RealArray | BoolArray, name: str) -> None:
        if image.shape != (self._camera.height, self._camera.width):
            size = "x".join(str(n) for n in reversed(image.shape))
            raise ImageError(f"{name}: {size} px, the camera has {self._camera.width}x{self._camera.height} px")

    def render(self, base_T_camera: FloatArray, wanted: BoolArray) -> VolumeView:
        """Return what the camera sees from a pose, at the wanted pixels (H, W).

        Raises
        ------
        ImageError
            The map of wanted pixels does not have the camera's size.
        PoseError
            The pose is no rigid motion.
        """
        self._check_size(wanted, "wanted pixels")
        nothing = np.full(wanted.shape, np.nan)
        source = np.full(wanted.shape, -1, dtype=np.intp)
        seen = VolumeView(nothing, nothing.copy(), source, nothing.copy())
        grid_T_camera = (self._grid_T_base @ validated_transform(base_T_camera, "render"))[:3]
        lens = np.array([self._camera.fx, self._camera.fy, self._camera.cx, self._camera.cy])
        grid, least = self._grid, self._settings.least_inlier_probability
        strips(lambda first, last: march(grid, grid_T_camera, lens, least, wanted, seen, first, last), len(wanted))
        return seen

    def mesh(self) -> SceneSurface:
        """Return the surfaces as triangles; where the volume knows both sides of it, and no farther.

        Its corners lie where the edges between neighbouring voxels cross the surface: they are the point cloud as well.
        """
        mesh = triangulated(self._grid, self._settings.least_inlier_probability)
        points_m = transform_points(self._base_T_grid, mesh.points_m)
        return SceneSurface(points_m, mesh.normals, mesh.sigma_m * self._settings.voxel_m, mesh.triangles)


def _chunks_of(region_m: Corners, voxel_m: float) -> tuple[FloatArray, tuple[int, int, int]]:
    """Return the lowest corner (3,) and how many chunks cover the region along each axis."""
    corners = np.array(region_m, dtype=np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
        raise SettingsError(f"region_m: is {corners.tolist()} m, needs a lowest and a higher corner, all finite")
    with np.errstate(over="ignore"):
        # a region of whole chunks is not to grow by rounding, and one beyond all numbers is refused by its memory
        across = np.minimum((corners[1] - corners[0]) / (CHUNK * voxel_m) - 1e-6, 1e100)
    chunks = [math.ceil(number) for number in across.tolist()]
    return corners[0], (max(chunks[0], 1), max(chunks[1], 1), max(chunks[2], 1))


def _check_memory(chunks: tuple[int, int, int], fixed_bytes: int, settings: VolumeSettings) -> None:
    """Refuse a region whose table and surfaces do not fit the memory allowed."""
    across = sorted(CHUNK // BLOCK * number for number in chunks)
    needed = fixed_bytes + SHEETS * across[1] * across[2] * BYTES_PER_SLOT
    if needed > settings.max_bytes:
        size = " x ".join(f"{number * CHUNK * settings.voxel_m * 1e3:g}" for number in chunks)
        raise SettingsError(
            f"volume: {size} mm in voxels of {settings.voxel_m * 1e3:g} mm need {needed} bytes at least, "
            f"limit max_bytes {settings.max_bytes}: shrink region_m or enlarge voxel_m"
        )
