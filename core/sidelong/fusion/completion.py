"""The completed depth of the reference view, as it grows with every further view."""

from __future__ import annotations

import hashlib
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sidelong.errors import DepthError, ImageError
from sidelong.fusion.consistency import Contradictions, agreement
from sidelong.fusion.engine import MISSING, Engine, PosedDepth
from sidelong.fusion.registration import Registered, as_the_arm_says, register, smoothed
from sidelong.fusion.settings import EngineName, FusionSettings
from sidelong.geometry.camera_model import LightProjector, PinholeCamera, StereoRig
from sidelong.geometry.transforms import invert, transform, validated_transform
from sidelong.types import (
    BoolArray,
    CompletedDepth,
    Float32Array,
    FloatArray,
    Frame,
    FusedView,
    PixelState,
    Projector,
    SceneModel,
    View,
)

REFERENCE = 0
"""Step of the reference view."""
LEAST_DEPTH_M, LARGEST_DEPTH_M = 1e-3, 100.0
"""No stereo camera at an arm measures as near or as far; what claims to is no depth."""
DIGEST_ROWS = 4
"""Every so many-th row tells one capture from another."""

Real = TypeVar("Real", np.float32, np.float64)


class Completion:
    """Completes the depth of a reference view from further views.

    Pixels the reference measured stay as they are, to the bit; where other views prove one wrong it is marked. All
    other pixels are given to an engine, which fuses what further views say of them, each view put right by what it
    shares with the reference. A view that contradicts the reference is refused. The order of the views does not matter.

    Parameters
    ----------
    reference
        The frame to complete.
    rig
        Cameras of this and of all further frames.
    settings
        How.

    Raises
    ------
    DepthError
        The reference frame has no depth map, or not one measured pixel.
    ImageError
        The depth map does not have the camera's size.
    PoseError
        The pose of the view is no rigid motion.
    """

    def __init__(self, reference: Frame, rig: StereoRig, settings: FusionSettings | None = None) -> None:
        self._rig = rig
        self._settings = settings or FusionSettings()
        self._camera_T_base = invert(_pose_of(reference))
        self._reference_m: FloatArray = _depth_of(reference, rig, np.float64)
        missing = np.isnan(self._reference_m)
        if missing.all():
            raise DepthError(f"view {reference.view.name}: the depth map has 0 of {missing.size} px measured")
        self._holes = np.flatnonzero(missing)
        """(N,) what the reference did not measure; holes are numbered row by row."""
        depth_m = self._reference_m.astype(np.float32)
        sigma_m = self._settings.noise.sigma_m(depth_m, rig)
        own = PosedDepth(REFERENCE, depth_m, sigma_m, np.eye(4), np.zeros((6, 6)))
        self._reference = own
        self._surface = smoothed(own.depth_m), own.sigma_m
        self._contradictions = Contradictions(own, rig.left, self._settings)
        self._engine = _engine_of(own, invert(self._camera_T_base), rig, self._settings)
        self._captures = {_digest(own.depth_m): reference.view.name}
        self._step = REFERENCE
        self._farthest_m: FloatArray = np.full(len(self._holes), np.inf)
        self._modelled: tuple[FloatArray, FloatArray] | None = None
        self._depth: CompletedDepth | None = None

    @property
    def depth(self) -> CompletedDepth:
        """The depth as all views show it; later views do not change what was handed out."""
        if self._depth is None:
            self._depth = self._completed()
        return self._depth

    @property
    def missing(self) -> BoolArray:
        """(H, W) pixels of which no view has told the depth, or a doubtful one only."""
        return ~np.isin(self.depth.state, (PixelState.MEASURED, PixelState.CONTRADICTED, PixelState.COMPLETED))

    @property
    def scene(self) -> SceneModel | None:
        """What the engine knows of the whole scene; None where it keeps the reference view alone."""
        return self._engine.scene

    def expect(self, surface_m: FloatArray, modelled: tuple[FloatArray, FloatArray] | None = None) -> None:
        """Say what is believed to be there.

        Completed pixels more than ``behind_m`` behind the believed surface are doubtful. Where no view has measured a
        part yet, another view may look past it and measure the ground, which then lands in the part's pixels; a nearer
        depth of a later view takes its place.

        Parameters
        ----------
        surface_m
            (H, W), NaN where nothing is believed.
        modelled
            Depth (H, W) that the CAD model gives where its pose is certain, NaN elsewhere, and its standard deviation;
            it fills pixels that no view measured. None: they stay missing.
        """
        believed_m = surface_m.reshape(-1)[self._holes]
        self._farthest_m = np.where(np.isnan(believed_m), np.inf, believed_m + self._settings.behind_m)
        self._modelled = modelled
        self._depth = None

    def add(self, frame: Frame) -> FusedView:
        """Fuse the depth map of a further view.

        A view is left out, and the result says why, if it has no depth, is a capture that was fused before, would have
        to be moved by more than the limits, or contradicts the reference.

        Raises
        ------
        DepthError
            The frame has no depth map.
        ImageError
            The depth map does not have the camera's size.
        PoseError
            The pose of the view is no rigid motion.
        """
        depth_m, pose = _depth_of(frame, self._rig, np.float32), self._camera_T_base @ _pose_of(frame)
        self._step += 1
        digest = _digest(depth_m)
        if not np.isfinite(depth_m).any():
            return _fused(as_the_arm_says(pose, None), float("nan"), f"0 of {depth_m.size} px measured")
        if digest in self._captures:
            return _fused(
                as_the_arm_says(pose, None), float("nan"), f"the same capture as view {self._captures[digest]}"
            )
        sigma_m = self._settings.noise.sigma_m(depth_m, self._rig)
        found = self._registered(depth_m, sigma_m, pose)
        view = PosedDepth(self._step, depth_m, sigma_m, found.reference_T_view, found.covariance)
        agreed = agreement(view, self._reference, self._rig.left, self._settings)
        refused = self._objection(found, agreed)
        if refused is not None:
            return _fused(found, agreed, refused)
        told, contradicted = self._told, self._contradictions.contradicted
        try:
            self._engine.add(view)
        except DepthError as error:  # no room for it
            return _fused(found, agreed, str(error))
        self._contradictions.add(view)
        self._captures[digest] = frame.view.name
        self._depth = None
        return _fused(
            found, agreed, None, int((self._told & ~told).sum()),
            int((self._contradictions.contradicted & ~contradicted).sum()),
        )  # fmt: skip

    @property
    def _told(self) -> BoolArray:
        """(N,) which holes some view has told the depth of."""
        return self._engine.estimate().source != MISSING

    def _registered(self, depth_m: Float32Array, sigma_m: Float32Array, pose: FloatArray) -> Registered:
        settings = self._settings.registration
        if settings is None:
            return as_the_arm_says(pose, None)
        return register((smoothed(depth_m), sigma_m), self._surface, pose, self._rig.left, settings)

    def _objection(self, found: Registered, agreed: float) -> str | None:
        """Say why a view must not be fused, if it must not."""
        limits = self._settings.registration
        if limits is not None and found.shift_m > limits.largest_shift_m:
            return f"would have to be moved by {found.shift_m * 1e3:.2f} mm, limit {limits.largest_shift_m * 1e3:g} mm"
        if limits is not None and found.turn_rad > limits.largest_turn_rad:
            return (
                f"would have to be turned by {np.rad2deg(found.turn_rad):.3f} degrees, "
                f"limit {np.rad2deg(limits.largest_turn_rad):.3g} degrees"
            )
        if agreed < self._settings.least_agreement:
            return (
                f"contradicts the reference: {agreed:.0%} of what both saw agrees, "
                f"limit {self._settings.least_agreement:.0%}"
            )
        return None

    def _completed(self) -> CompletedDepth:
        estimate = self._engine.estimate()
        depth_m, sigma_m = self._reference_m.copy(), self._reference.sigma_m.astype(np.float64)
        source, state = np.zeros(depth_m.shape, dtype=np.intp), np.full(depth_m.shape, PixelState.MEASURED, np.uint8)
        state[self._contradictions.contradicted] = PixelState.CONTRADICTED
        filled = np.where(estimate.source == MISSING, PixelState.MISSING, PixelState.COMPLETED).astype(np.uint8)
        with np.errstate(invalid="ignore"):
            filled[estimate.depth_m > self._farthest_m] = PixelState.DOUBTFUL
        values = (estimate.depth_m, estimate.sigma_m, estimate.source, filled)
        for whole, at_holes in zip((depth_m, sigma_m, source, state), values, strict=True):
            whole.reshape(-1)[self._holes] = at_holes
        if self._modelled is not None:
            by_model = (state == PixelState.MISSING) & np.isfinite(self._modelled[0])
            depth_m[by_model], sigma_m[by_model] = (values[by_model] for values in self._modelled)
            state[by_model] = PixelState.MODELLED
        return CompletedDepth(depth_m, sigma_m, source, state)


def prepare(settings: FusionSettings) -> None:
    """Compile the loops of the fusion, or load them from where they are kept, before a camera waits for them."""
    camera = PinholeCamera(width=64, height=64, fx=80.0, fy=80.0, cx=31.5, cy=31.5)
    rig = StereoRig(camera, camera, 0.1, LightProjector(np.eye(4), 0.5, 0.5))
    depth_m = np.full((64, 64), 0.5)
    depth_m[20:30, 20:30] = np.nan
    region = (-0.1, -0.1, 0.45), (0.1, 0.1, 0.55)
    volume = settings.volume.model_copy(update={"region_m": region, "voxel_m": 5e-3, "front_m": 0.02, "behind_m": 0.02})
    completion = Completion(_captured(depth_m, 0.0), rig, settings.model_copy(update={"volume": volume}))
    completion.add(_captured(depth_m, 2e-3))


def _captured(depth_m: FloatArray, x_m: float) -> Frame:
    blank = np.zeros(depth_m.shape, dtype=np.uint8)
    view = View("prepare", transform(np.eye(3), (x_m, 0.0, 0.0)))
    return Frame(view, blank, None, depth_m + x_m, Projector.DOTS, exposure_s=1.0)


def _engine_of(own: PosedDepth, base_T_reference: FloatArray, rig: StereoRig, settings: FusionSettings) -> Engine:
    """Make the engine; what the other one needs is not imported."""
    wanted = np.isnan(own.depth_m)
    if settings.engine is EngineName.VOLUME:
        from sidelong.fusion.volume.engine import VolumeEngine

        return VolumeEngine(rig.left, own, base_T_reference, wanted, settings.volume)
    from sidelong.fusion.warping.engine import WarpEngine

    return WarpEngine(rig.left, wanted, settings)


def _fused(
    at: Registered, agreed: float, refused: str | None, filled_px: int = 0, contradicted_px: int = 0
) -> FusedView:
    variance = np.diag(at.covariance)
    return FusedView(
        reference_T_view=at.reference_T_view,
        refused=refused,
        shift_m=at.shift_m,
        turn_rad=at.turn_rad,
        sigma_shift_m=float(np.sqrt(variance[3:].sum())),
        sigma_turn_rad=float(np.sqrt(variance[:3].sum())),
        shared_points=at.shared_points,
        agreement=agreed,
        filled_px=filled_px,
        contradicted_px=contradicted_px,
    )


def _digest(depth_m: Float32Array) -> bytes:
    """Tell captures apart: noise differs in each, so equal depths are one capture."""
    return hashlib.blake2b(depth_m[::DIGEST_ROWS].tobytes(), digest_size=16).digest()


def _depth_of(frame: Frame, rig: StereoRig, kind: type[Real]) -> NDArray[Real]:
    """Return the depth map of a frame, checked for presence and size; NaN where it is no length."""
    if frame.depth_m is None:
        raise DepthError(f"view {frame.view.name}: the frame has no depth map, it was captured without")
    camera = rig.left
    if frame.depth_m.shape != (camera.height, camera.width):
        size = "x".join(str(n) for n in reversed(frame.depth_m.shape))
        raise ImageError(
            f"view {frame.view.name}: the depth map is {size} px, the camera {camera.width}x{camera.height} px"
        )
    depth_m = frame.depth_m.astype(kind)
    depth_m[~((frame.depth_m >= LEAST_DEPTH_M) & (frame.depth_m <= LARGEST_DEPTH_M))] = np.nan
    return depth_m


def _pose_of(frame: Frame) -> FloatArray:
    return validated_transform(frame.view.base_T_camera, f"view {frame.view.name}")
