"""What is special to recorded devices: only recorded places, and images and exposures as far as they were recorded."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sidelong.devices import CaptureRequest
from sidelong.errors import DatasetError, DeviceUnavailableError, ImageError, MotionRefusedError, UnknownNameError
from sidelong.geometry.transforms import rotation_about, transform
from sidelong.recorded.dataset import Dataset, Scene
from sidelong.types import FloatArray, Projector
from sidelong_drivers.replay import ReplayArm, ReplayCamera, ReplaySettings

ROBI = Path(__file__).parents[1] / "data" / "robi"
SCENE = "Tube_fitting/Scene_1"
OFF, DOTS = CaptureRequest(Projector.OFF, 0.05), CaptureRequest(Projector.DOTS, 0.05)
DEPTH = CaptureRequest(Projector.DOTS, 0.05, depth=True)


def settings_for(root: Path) -> ReplaySettings:
    return ReplaySettings(root=root, object="Tube_fitting", scene=1)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Dataset(ROBI).scene("Tube_fitting", 1)


@pytest.fixture(scope="module")
def camera() -> Iterator[ReplayCamera]:
    device = ReplayCamera(settings_for(ROBI))
    device.open()
    yield device
    device.close()


@pytest.fixture
def arm() -> Iterator[ReplayArm]:
    device = ReplayArm(settings_for(ROBI))
    device.open()
    yield device
    device.close()


@pytest.fixture
def copy(tmp_path: Path) -> Iterator[Path]:
    root = tmp_path / "robi"
    shutil.copytree(ROBI, root, copy_function=shutil.copyfile)
    yield root
    shutil.rmtree(root)


@pytest.fixture
def camera_of_copy(copy: Path) -> Iterator[ReplayCamera]:
    device = ReplayCamera(settings_for(copy))
    device.open()
    yield device
    device.close()


def pose_of(scene: Scene, name: str) -> FloatArray:
    return scene.view(name).base_T_camera


def moved(pose: FloatArray, along_m: float = 0.0, turned_rad: float = 0.0) -> FloatArray:
    """Shift and turn a camera along and about its own axes."""
    return pose @ transform(rotation_about((0, 1, 0), turned_rad), (along_m, 0.0, 0.0))


# --- images ---


def test_what_was_recorded_at_the_view_is_what_is_captured(camera: ReplayCamera, scene: Scene) -> None:
    for name in scene.names:
        frame = camera.capture(OFF, pose_of(scene, name))
        assert frame.view.name == name
        np.testing.assert_array_equal(frame.left, scene.image(name, Projector.OFF))
        depth_m = camera.capture(DEPTH, pose_of(scene, name)).depth_m
        assert depth_m is not None
        np.testing.assert_array_equal(depth_m, scene.depth_m(name))


def test_a_pattern_image_is_given_where_there_is_one(camera: ReplayCamera, scene: Scene) -> None:
    frame = camera.capture(DEPTH, pose_of(scene, "view_0"))
    assert frame.projector is Projector.DOTS
    np.testing.assert_array_equal(frame.left, scene.image("view_0", Projector.DOTS))
    np.testing.assert_array_equal(frame.right, scene.image("view_0", Projector.DOTS, "RIGHT"))


def test_a_depth_map_comes_with_the_image_without_pattern_where_no_pattern_image_is(
    camera: ReplayCamera, scene: Scene
) -> None:
    """The exposure stays that of the depth, 12 ms: the planner foresees depth by it. The image had 200 ms."""
    frame = camera.capture(DEPTH, pose_of(scene, "view_4"))
    assert frame.projector is Projector.OFF
    np.testing.assert_array_equal(frame.left, scene.image("view_4", Projector.OFF))
    assert frame.right is None
    assert frame.exposure_s == pytest.approx(0.012)


@pytest.mark.parametrize("projector", [Projector.DOTS, Projector.WHITE])
def test_an_image_alone_has_no_stand_in(camera: ReplayCamera, scene: Scene, projector: Projector) -> None:
    message = f"{SCENE}: view view_4 has no left image with the projector at {projector}$"
    with pytest.raises(ImageError, match=message):
        camera.capture(CaptureRequest(projector, 0.05), pose_of(scene, "view_4"))


def test_without_any_image_there_is_no_frame(copy: Path, camera_of_copy: ReplayCamera, scene: Scene) -> None:
    (copy / SCENE / "Ensenso/Stereo/LEFT_view_8.bmp").unlink()
    for request in (OFF, DEPTH):
        with pytest.raises(ImageError, match=r"view view_8 has no left image with the projector at off$"):
            camera_of_copy.capture(request, pose_of(scene, "view_8"))
    assert camera_of_copy.capture(OFF, pose_of(scene, "view_4")).view.name == "view_4"


@pytest.mark.parametrize(("request_", "file"), [(OFF, "Stereo/LEFT_view_0.bmp"), (DEPTH, "Depth/DEPTH_view_0.png")])
def test_a_file_damaged_after_opening_is_named(
    copy: Path, camera_of_copy: ReplayCamera, scene: Scene, request_: CaptureRequest, file: str
) -> None:
    path = copy / SCENE / "Ensenso" / file
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(ImageError, match=rf"{file}: the image is truncated or damaged"):
        camera_of_copy.capture(request_, pose_of(scene, "view_0"))


# --- exposures ---


def write_exposure(path: Path, exposure_ms: float) -> None:
    about = json.loads(path.read_text()) if path.is_file() else {}
    path.write_text(json.dumps(about | {"exposure_ms": exposure_ms}))


def test_the_exposure_beside_an_image_goes_before_that_of_the_rig(
    copy: Path, camera_of_copy: ReplayCamera, scene: Scene
) -> None:
    write_exposure(copy / SCENE / "Ensenso/Stereo/LEFT_view_0.json", 150.0)
    write_exposure(copy / SCENE / "Ensenso/StereoPattern/LEFT_view_0.json", 7.0)
    assert camera_of_copy.capture(OFF, pose_of(scene, "view_0")).exposure_s == pytest.approx(0.150)
    assert camera_of_copy.capture(DOTS, pose_of(scene, "view_0")).exposure_s == pytest.approx(0.007)
    assert camera_of_copy.capture(OFF, pose_of(scene, "view_4")).exposure_s == pytest.approx(0.200)
    assert camera_of_copy.capture(DEPTH, pose_of(scene, "view_4")).exposure_s == pytest.approx(0.012)


def test_where_no_file_tells_the_exposure_asked_for_is_reported(copy: Path, scene: Scene) -> None:
    (copy / "cam/rig.json").unlink()
    camera = ReplayCamera(settings_for(copy))
    camera.open()
    assert camera.capture(DEPTH, pose_of(scene, "view_4")).exposure_s == 0.05
    assert camera.capture(OFF, pose_of(scene, "view_4")).exposure_s == pytest.approx(0.200)
    camera.close()


# --- places ---


@pytest.mark.parametrize(("along_m", "turned_rad"), [(0.9e-6, 0.0), (0.0, 0.9e-6), (-0.5e-6, 0.5e-6)])
def test_rounding_leaves_a_recorded_place_the_same(
    camera: ReplayCamera, arm: ReplayArm, scene: Scene, along_m: float, turned_rad: float
) -> None:
    near = moved(pose_of(scene, "view_10"), along_m, turned_rad)
    assert camera.capture(OFF, near).view.name == "view_10"
    assert arm.unreachable(near) is None
    np.testing.assert_allclose(arm.move(near, 1.0).base_T_flange, pose_of(scene, "view_10"), atol=2e-6)


@pytest.mark.parametrize(
    ("along_m", "turned_rad", "away"),
    [
        (1.1e-6, 0.0, r"0\.0011 mm and \S+ degrees"),
        (0.0, 1.1e-6, r"\S+ mm and 6\.3e-05 degrees"),
        (3e-3, 0.0, r"3 mm and \S+ degrees"),
        (0.0, np.deg2rad(5.0), r"\S+ mm and 5 degrees"),
        (0.012, np.deg2rad(20.0), r"12 mm and 20 degrees"),
    ],
)
def test_elsewhere_nothing_was_recorded_and_the_nearest_view_is_named(
    camera: ReplayCamera, arm: ReplayArm, scene: Scene, along_m: float, turned_rad: float, away: str
) -> None:
    beside = moved(pose_of(scene, "view_10"), along_m, turned_rad)
    why = (
        f"nothing was recorded at this pose; the nearest view, view_10, is {away} away, "
        r"limits 0\.001 mm and 5\.7e-05 degrees$"
    )
    with pytest.raises(ImageError, match=f"^replay camera: {why}"):
        camera.capture(OFF, beside)
    with pytest.raises(MotionRefusedError, match=f"^replay arm: {why}"):
        arm.move(beside, 1.0)
    reason = arm.unreachable(beside)
    assert reason is not None
    assert reason.startswith("nothing was recorded at this pose; the nearest view, view_10, is")


def test_the_arm_stands_at_the_first_view_of_the_list_and_has_no_joints(copy: Path, scene: Scene) -> None:
    (copy / SCENE / "Ensenso/list.txt").write_text("view_8\nview_0\n")
    arm = ReplayArm(settings_for(copy))
    arm.open()
    np.testing.assert_array_equal(arm.state().base_T_flange, pose_of(scene, "view_8"))
    assert arm.state().joints_rad.shape == (0,)
    # view_4 has its files still, but is not on the list
    assert arm.unreachable(pose_of(scene, "view_0")) is None
    assert arm.unreachable(pose_of(scene, "view_4")) is not None
    arm.move(pose_of(scene, "view_0"), 1.0)
    arm.open()
    np.testing.assert_array_equal(arm.state().base_T_flange, pose_of(scene, "view_8"))
    arm.close()


# --- opening ---


@pytest.mark.parametrize("device_of", [ReplayCamera, ReplayArm])
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (ReplaySettings(root=ROBI / "nowhere", object="Tube_fitting"), "nowhere: no such data set folder"),
        (ReplaySettings(root=ROBI, object="Gear"), "object 'Gear' is unknown, known are Tube_fitting"),
        (ReplaySettings(root=ROBI, object="Tube_fitting", scene=9), "scene 9 is unknown, known are 1"),
    ],
)
def test_a_scene_that_is_not_there_is_refused_at_open_and_it_stays_closed(
    device_of: type[ReplayCamera | ReplayArm], settings: ReplaySettings, message: str
) -> None:
    device = device_of(settings)
    with pytest.raises(UnknownNameError, match=message):
        device.open()
    use = (lambda: device.rig) if isinstance(device, ReplayCamera) else device.state
    with pytest.raises(DeviceUnavailableError, match=f"{device.name}: is not open"):
        use()
    device.close()


def test_a_camera_reads_its_intrinsics_at_open(copy: Path) -> None:
    (copy / "cam/Ensenso_RIGHT.yml").unlink()
    camera = ReplayCamera(settings_for(copy))
    with pytest.raises(DatasetError, match=r"Ensenso_RIGHT\.yml: the file is missing"):
        camera.open()
    # an arm needs none
    arm = ReplayArm(settings_for(copy))
    arm.open()
    arm.close()
