"""Takes the captures that calibrations are made from, and writes them in the layout that is read. Nothing moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sidelong.devices import Camera, CaptureRequest
from sidelong.errors import DatasetError, DepthError
from sidelong.recorded.files import MM
from sidelong.recorded.writing import add_to_json, pose_to_mm, write_depth, write_gray, write_json, write_rig
from sidelong.types import Float32Array, FloatArray, Frame, Projector


@dataclass(frozen=True, eq=False)
class Recorder:
    """A camera at rest and the data set its captures go to.

    Attributes
    ----------
    camera
        Opened.
    base_T_flange, base_T_camera
        (4, 4) where flange and camera are now, as the arm says.
    root
        Folder of the data set; made where there is none.
    object
        Whose captures they are; None for those of the device.
    """

    camera: Camera
    base_T_flange: FloatArray
    base_T_camera: FloatArray
    root: Path
    object: str | None = None

    def bracket(
        self, exposures_s: Sequence[float], projector: Projector, progress: Callable[[int, int], None]
    ) -> tuple[Path, ...]:
        """Take images at several exposures and return their files; an older bracket gives way to the new one.

        Raises
        ------
        DeviceError, InputError
            A capture failed.
        DatasetError
            The folder holds the recordings of another camera.
        OSError
            A file cannot be written.
        """
        frames: list[Frame] = []
        for exposure_s in exposures_s:
            progress(len(frames), len(exposures_s))
            frames.append(self._frame(projector, exposure_s))
        folder = self._folder("Response")
        for old in folder.glob("LEFT_*.bmp"):
            old.unlink()
        files = tuple(folder / f"LEFT_{frame.exposure_s / MM:g}ms.bmp" for frame in frames)
        for file, frame in zip(files, frames, strict=True):
            write_gray(file, frame.left)
        times = {file.name: frame.exposure_s / MM for file, frame in zip(files, frames, strict=True)}
        write_json(folder / "times.json", {"unit": "ms", "times": times})
        return files

    def white(self, exposures_s: Sequence[float]) -> tuple[Path, ...]:
        """Take both images under the white pattern, and with the projector off, and return their files.

        The first exposure is the one of depth captures; shorter ones measure what saturates in it. Older images give
        way.

        Raises as ``bracket``.
        """
        lit = [self._frame(Projector.WHITE, exposure_s) for exposure_s in exposures_s]
        dark = self._frame(Projector.OFF, exposures_s[0])
        folder = self._folder("Phong")
        for old in folder.glob("*_white_*"):
            old.unlink()
        files = [*self._write_images(folder, "white", lit[0]), *self._write_images(folder, "off", dark)]
        for index, frame in enumerate(lit[1:], start=1):
            files += self._write_images(folder, f"white_{index}", frame)
        return tuple(files)

    def sprayed(self, exposure_s: float) -> tuple[Path, ...]:
        """Take the depth of the scene once it is sprayed, and return its file. Raises as ``bracket``."""
        frame, file = self._depth_frame(exposure_s), self._folder("Phong") / "DEPTH_sprayed.png"
        write_depth(file, self._depth_of(frame))
        write_json(file.with_suffix(".json"), self._about(frame))
        return (file,)

    def plane(self, exposure_s: float) -> tuple[Path, ...]:
        """Take images and depth of a matte plane beside those that are there; return the files.

        Raises as ``bracket``.
        """
        lit, dark = self._frame(Projector.WHITE, exposure_s), self._frame(Projector.OFF, exposure_s)
        depth = self._depth_frame(exposure_s)
        folder = self._folder("Plane")
        index = _next_index(folder, "LEFT_white_")
        picture = folder / f"DEPTH_{index}.png"
        write_depth(picture, self._depth_of(depth))
        # the white image last: by it captures are known
        room = self._write_images(folder, f"off_{index}", dark)
        return (picture, *room, *self._write_images(folder, f"white_{index}", lit))

    def repeats(self, exposure_s: float, count: int, progress: Callable[[int, int], None]) -> tuple[Path, ...]:
        """Take the depth of a scene at rest again and again, and return the files; older ones give way.

        Raises as ``bracket``.
        """
        maps: list[Float32Array] = []
        for done in range(count):
            progress(done, count)
            # images of dozens of shots are much to hold
            maps.append(self._depth_of(self._depth_frame(exposure_s)).astype(np.float32))
        folder = self._folder("Repeats")
        for old in folder.glob("DEPTH_*.png"):
            old.unlink()
        files = tuple(folder / f"DEPTH_{index}.png" for index in range(count))
        for file, depth_m in zip(files, maps, strict=True):
            write_depth(file, depth_m.astype(np.float64))
        return files

    def board(self, exposure_s: float, projector: Projector) -> tuple[Path, ...]:
        """Take an image of the board beside those that are there, keep the arm's pose, and return the file.

        Raises as ``bracket``.
        """
        frame, folder = self._frame(projector, exposure_s), self._folder("HandEye")
        image = folder / f"LEFT_{_next_index(folder, 'LEFT_')}.bmp"
        write_gray(image, frame.left)
        add_to_json(folder / "poses.json", "poses", **{image.name: pose_to_mm(self.base_T_flange)})
        return (image,)

    def _frame(self, projector: Projector, exposure_s: float, *, depth: bool = False) -> Frame:
        frame = self.camera.capture(CaptureRequest(projector, exposure_s, depth=depth), self.base_T_camera)
        if frame.projector is not projector:
            raise DatasetError(f"{self.camera.name}: shows {frame.projector}, {projector} was asked for")
        return frame

    def _depth_frame(self, exposure_s: float) -> Frame:
        return self._frame(Projector.DOTS, exposure_s, depth=True)

    def _depth_of(self, frame: Frame) -> FloatArray:
        if frame.depth_m is None:
            raise DepthError(f"{self.camera.name}: gave no depth map")
        return frame.depth_m

    def _write_images(self, folder: Path, name: str, frame: Frame) -> tuple[Path, ...]:
        images = {"LEFT": frame.left} | ({"RIGHT": frame.right} if frame.right is not None else {})
        files = tuple(folder / f"{side}_{name}.bmp" for side in images)
        for file, image in zip(files, images.values(), strict=True):
            write_json(file.with_suffix(".json"), self._about(frame))
            write_gray(file, image)
        return files

    def _about(self, frame: Frame) -> dict[str, object]:
        return {"cam_pose": pose_to_mm(self.base_T_camera), "exposure_ms": frame.exposure_s / MM}

    def _folder(self, kind: str) -> Path:
        """Return the folder of captures of a kind, in a data set of this camera."""
        write_rig(self.root, self.camera.rig, self.camera.serial)
        folder = (self.root / self.object if self.object else self.root) / "Calibration" / kind
        folder.mkdir(parents=True, exist_ok=True)
        return folder


def _next_index(folder: Path, beginning: str) -> int:
    """Return a number that no image has, though some of them may have been deleted."""
    endings = (file.stem.removeprefix(beginning) for file in folder.glob(f"{beginning}*.bmp"))
    return 1 + max((int(ending) for ending in endings if ending.isdecimal()), default=-1)
