"""Templates: trained, stored, matched in a process that may die."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from detection_scene import CAMERA, bracket, photograph, true_poses

from sidelong.detection.matcher_process import MatcherProcess, Matches
from sidelong.detection.proposals import poses_on_rays
from sidelong.detection.search_region import resized, search_region
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.template_cache import cache_key, load_or_train
from sidelong.detection.templates import FILE, TemplateSet, distances
from sidelong.detection.viewsphere import views
from sidelong.errors import DetectionError, ImageError, MatcherDiedError, SettingsError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import rotation_about, transform
from sidelong.types import FloatArray, GrayImage

TINY = DetectionSettings(view_step_deg=60, roll_step_deg=60, distance_m=(0.7, 0.7), span_px=48)
FINE = DetectionSettings(view_step_deg=20, roll_step_deg=15, distance_m=(0.7, 0.7), span_px=48)
PICTURES = len(views(60, 60, bracket().symmetry))


@pytest.fixture(scope="module")
def fine(tmp_path_factory: pytest.TempPathFactory) -> TemplateSet:
    return load_or_train(bracket(), CAMERA, FINE, tmp_path_factory.mktemp("templates"))


def _searched(image: GrayImage, templates: TemplateSet) -> GrayImage:
    import cv2

    size = tuple(round(side * templates.focal_px / CAMERA.fx) for side in image.shape[::-1])
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _match(image: GrayImage, templates: TemplateSet, region: np.ndarray | None = None) -> tuple[Matches, FloatArray]:
    """Return the matches, and their centres in pixels of the image."""
    matcher = MatcherProcess(templates, FINE)
    try:
        found = matcher.match(_searched(image, templates), region)
    finally:
        matcher.close()
    return found, (found.centre_px + 0.5) * CAMERA.fx / templates.focal_px - 0.5


def test_matches_lie_on_the_part_without_bias(fine: TemplateSet):
    offsets: list[FloatArray] = []
    for k in range(12):
        pose = transform(
            rotation_about((0, 0, 1), 0.5 * k) @ rotation_about((1, 0.3, 0), 0.5), (0.004 * k - 0.02, 0, 0.7)
        )
        _, uv = _match(photograph(bracket(), [pose], CAMERA, seed=k), fine)
        offsets.append(uv[0] - CAMERA.project(pose[:3, :3] @ bracket().centre_m + pose[:3, 3]))
    # of a part 45 px long; the grid is 5.6 px wide
    assert np.linalg.norm(offsets, axis=1).max() < 6.0
    assert np.abs(np.mean(offsets, axis=0)).max() < 2.0


def test_matches_are_limited_to_the_region(fine: TemplateSet):
    image = photograph(bracket(), true_poses(), CAMERA)
    everywhere, _ = _match(image, fine)
    half = np.zeros(image.shape, np.bool_)
    half[:, :160] = True
    found, uv = _match(image, fine, resized(half, _searched(image, fine).shape))
    assert 0 < found.total < everywhere.total
    assert uv[:, 0].max() < 161
    assert np.linalg.norm(uv[0] - CAMERA.project(true_poses()[0][:3, 3])) < 12
    nothing, _ = _match(image, fine, np.zeros(_searched(image, fine).shape, np.bool_))
    assert nothing.total == 0


@pytest.mark.parametrize("kind", ["black", "white", "noise", "checkerboard", "one pixel"])
def test_images_of_nothing_are_answered(fine: TemplateSet, kind: str):
    rng = np.random.default_rng(0)
    images = {
        "black": np.zeros((512, 640), np.uint8),
        "white": np.full((512, 640), 255, np.uint8),
        "noise": rng.integers(0, 256, (512, 640), dtype=np.uint8),
        "checkerboard": (255 * (np.indices((512, 640)).sum(axis=0) // 8 % 2)).astype(np.uint8),
        "one pixel": np.zeros((1, 1), np.uint8),
    }
    matcher = MatcherProcess(fine, FINE)
    try:
        found = matcher.match(images[kind])
    finally:
        matcher.close()
    assert np.isfinite(found.score).all()
    assert len(found.row) <= FINE.max_matches
    if kind in ("black", "white", "one pixel"):
        assert found.total == 0


def test_a_missed_deadline_is_an_error(fine: TemplateSet):
    matcher = MatcherProcess(fine, FINE.model_copy(update={"deadline_s": 0.001}))
    with pytest.raises(MatcherDiedError, match=r"deadline of 0\.001 s"):
        matcher.match(photograph(bracket(), true_poses(), CAMERA))
    assert matcher.pid is None


def test_a_segmentation_fault_is_an_error_and_the_next_call_works(fine: TemplateSet):
    matcher, image = MatcherProcess(fine, FINE), photograph(bracket(), true_poses(), CAMERA)
    try:
        expected = matcher.match(image).total
        assert matcher.pid is not None
        os.kill(matcher.pid, signal.SIGSEGV)
        with pytest.raises(MatcherDiedError, match="ended with code -11"):
            matcher.match(image)
        assert matcher.match(image).total == expected
    finally:
        matcher.close()


def test_templates_are_trained_once(tmp_path: Path):
    pictures: list[tuple[int, int]] = []
    first = load_or_train(bracket(), CAMERA, TINY, tmp_path, lambda done, total: pictures.append((done, total)))
    assert pictures[-1] == (PICTURES, PICTURES)
    pictures.clear()
    again = load_or_train(bracket(), CAMERA, TINY, tmp_path, lambda done, total: pictures.append((done, total)))
    assert pictures == []
    np.testing.assert_array_equal(again.axis_R_object, first.axis_R_object)
    assert [entry.name for entry in tmp_path.iterdir()] == [cache_key(bracket(), CAMERA, TINY)]


@pytest.mark.parametrize("name", [FILE, "entry.json"])
@pytest.mark.parametrize("damage", ["truncated", "missing"])
def test_damaged_templates_are_trained_again(tmp_path: Path, name: str, damage: str):
    whole = load_or_train(bracket(), CAMERA, TINY, tmp_path)
    victim = whole.folder / name
    if damage == "missing":
        victim.unlink()
    else:
        victim.write_bytes(victim.read_bytes()[:-50])
    pictures: list[int] = []
    again = load_or_train(bracket(), CAMERA, TINY, tmp_path, lambda done, _: pictures.append(done))
    assert pictures[-1] == PICTURES
    np.testing.assert_array_equal(again.distance_m, whole.distance_m)


def test_training_ends_when_progress_raises_and_leaves_nothing(tmp_path: Path):
    class CancelledError(Exception):
        pass

    def cancel(done: int, total: int) -> None:
        nonlocal asked_s
        if done >= 5:
            asked_s = asked_s or time.monotonic()
            raise CancelledError

    asked_s = 0.0
    with pytest.raises(CancelledError):
        load_or_train(bracket(), CAMERA, FINE.model_copy(update={"view_step_deg": 8.0}), tmp_path, cancel)
    assert time.monotonic() - asked_s < 10
    assert list(tmp_path.iterdir()) == []
    assert not [thread for thread in threading.enumerate() if "ThreadPool" in thread.name]


def test_what_a_killed_training_left_is_removed_and_a_living_ones_is_not(tmp_path: Path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    (tmp_path / f"training-{ended.pid}-x").mkdir()
    alive = tmp_path / f"training-{os.getppid()}-x"
    alive.mkdir()
    load_or_train(bracket(), CAMERA, TINY, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([alive.name, cache_key(bracket(), CAMERA, TINY)])


def test_the_key_changes_with_part_camera_and_training_but_not_with_matching():
    key = cache_key(bracket(), CAMERA, TINY)
    assert cache_key(bracket(), CAMERA.scaled(0.5), TINY) != key
    assert cache_key(bracket(), CAMERA, TINY.model_copy(update={"roll_step_deg": 30.0})) != key
    assert cache_key(bracket(), CAMERA, TINY.model_copy(update={"temperature": 1.0})) == key


@pytest.mark.parametrize(
    ("focal_px", "message"),
    [(40.0, r"bracket: spans 8\.\d+ px at 0.7 m .* need 24 px"), (8000.0, r"bracket: spans \d+\.\d px .* 320x256 px")],
)
def test_a_part_that_does_not_fit_the_image_is_refused(tmp_path: Path, focal_px: float, message: str):
    camera = PinholeCamera(320, 256, focal_px, focal_px, 159.5, 127.5)
    with pytest.raises(DetectionError, match=message):
        load_or_train(bracket(), camera, TINY, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_region_is_the_settings_and_the_mask():
    mask = np.ones((256, 320), np.bool_)
    mask[:100] = False
    assert search_region(CAMERA, FINE, None) is None
    settings = FINE.model_copy(update={"region_px": (10, 50, 110, 150)})
    region = search_region(CAMERA, settings, mask)
    assert region is not None
    assert region.sum() == 100 * 50
    assert region[100:150, 10:110].all()
    half = resized(region, (128, 160))
    assert half.sum() == 50 * 25
    with pytest.raises(ImageError, match="mask is bool"):
        search_region(CAMERA, FINE, mask[:10])
    with pytest.raises(SettingsError, match="image has 320x256 px"):
        search_region(CAMERA, FINE.model_copy(update={"region_px": (0, 0, 400, 10)}), None)


def test_distances_are_equal_ratios_inside_the_range():
    found = distances(DetectionSettings(distance_m=(0.5, 1.0), distance_ratio=1.2))
    ratios = found[1:] / found[:-1]
    assert found[0] > 0.5
    assert found[-1] < 1.0
    np.testing.assert_allclose(ratios, ratios[0])
    assert ratios[0] <= 1.2


def test_a_pose_on_the_ray_projects_to_the_pixel():
    centre_m = np.array([0.01, -0.02, 0.005])
    turn = rotation_about((1, 2, 3), 0.4)[None]
    pose = poses_on_rays(np.array([[40.0, 200.0]]), CAMERA, turn, np.array([0.7]), centre_m)[0]
    np.testing.assert_allclose(CAMERA.project(pose[:3, :3] @ centre_m + pose[:3, 3]), [40.0, 200.0], atol=1e-9)
