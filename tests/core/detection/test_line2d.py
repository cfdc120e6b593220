"""Detection of a rendered bracket: poses, the template cache, bad images, a matcher that dies."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from detection_scene import CAMERA, bracket, photograph, true_poses
from pydantic import ValidationError

from sidelong.detection.contours import ContourModel, EdgeField
from sidelong.detection.line2d import Line2DDetector
from sidelong.detection.matcher_process import MatcherProcess
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.template_cache import cache_key, load_or_train
from sidelong.detection.templates import distances, new_detector, pose_on_ray, view_directions
from sidelong.errors import DetectionError, ImageError, MatcherDiedError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import rotation_about, rotation_angle
from sidelong.types import FloatArray

SETTINGS = DetectionSettings(view_step_deg=30, roll_step_deg=20, distance_m=(0.65, 0.75), span_px=48)
TINY = DetectionSettings(view_step_deg=60, roll_step_deg=60, distance_m=(0.7, 0.7), span_px=48)
DARK = np.full((CAMERA.height, CAMERA.width), 20, dtype=np.uint8)


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Line2DDetector]:
    with Line2DDetector(bracket(), CAMERA, SETTINGS, tmp_path_factory.mktemp("templates")) as made:
        made.prepare()
        yield made


def _image() -> np.ndarray:
    return photograph(bracket(), true_poses(), CAMERA)


def _off_px(pose: FloatArray, truth: FloatArray) -> float:
    return float(np.linalg.norm(CAMERA.project(pose[:3, 3]) - CAMERA.project(truth[:3, 3])))


def test_both_parts_are_found_where_they_are(detector: Line2DDetector):
    objects = detector.detect(_image())
    assert len(objects) == 2
    for truth in true_poses():
        near = min(objects, key=lambda found: _off_px(found.hypotheses[0].camera_T_object, truth))
        assert _off_px(near.hypotheses[0].camera_T_object, truth) < 3.0
        best = min(rotation_angle(h.camera_T_object[:3, :3].T @ truth[:3, :3]) for h in near.hypotheses)
        assert np.degrees(best) < 15.0
        assert near.hypotheses[0].camera_T_object[2, 3] == pytest.approx(truth[2, 3], rel=0.05)


def test_hypotheses_come_ranked_with_probabilities_of_one(detector: Line2DDetector):
    for found in detector.detect(_image()):
        probabilities = [h.probability for h in found.hypotheses]
        scores = [h.score for h in found.hypotheses]
        assert sum(probabilities) == pytest.approx(1.0)
        assert scores == sorted(scores, reverse=True)
        assert all(0 <= score <= 100 for score in scores)
        assert len(found.hypotheses) <= SETTINGS.hypotheses_per_object


def test_the_report_says_what_was_done(detector: Line2DDetector):
    detector.detect(_image())
    report = detector.last_report
    assert report is not None
    assert report.matches >= report.matches_kept > 0
    assert report.match_s > 0


@pytest.mark.parametrize("level", [0, 20, 255])
def test_a_blank_image_holds_no_object(detector: Line2DDetector, level: int):
    assert detector.detect(np.full_like(DARK, level)) == ()


def test_noise_holds_no_object(detector: Line2DDetector):
    noise = np.random.default_rng(1).poisson(40, DARK.shape).astype(np.uint8)
    assert detector.detect(noise) == ()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (DARK.astype(np.float64), "type is float64, needs uint8"),
        (np.dstack([DARK] * 3), r"has 3 dimensions \(256, 320, 3\), needs 2"),
        (DARK[:200], "is 320x200 px, the camera's are 320x256 px"),
        (DARK[:0], "is 320x0 px, the camera's are 320x256 px"),
    ],
)
def test_wrong_images_are_refused(detector: Line2DDetector, image: np.ndarray, message: str):
    with pytest.raises(ImageError, match=message):
        detector.detect(image)


def test_a_matcher_that_was_killed_is_an_error_and_the_next_call_works(detector: Line2DDetector):
    expected = len(detector.detect(_image()))
    pid = detector.matcher_pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(MatcherDiedError, match="ended with code -9"):
        detector.detect(_image())
    assert len(detector.detect(_image())) == expected
    assert detector.matcher_pid != pid


def test_close_ends_the_child_and_may_be_repeated(tmp_path: Path):
    detector = Line2DDetector(bracket(), CAMERA, TINY, tmp_path)
    detector.detect(_image())
    pid = detector.matcher_pid
    assert pid is not None
    detector.close()
    detector.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_missed_deadline_is_an_error(tmp_path: Path):
    settings = TINY.model_copy(update={"deadline_s": 0.001})
    with Line2DDetector(bracket(), CAMERA, settings, tmp_path) as detector:
        with pytest.raises(MatcherDiedError, match=r"deadline of 0\.001 s"):
            detector.detect(_image())
        assert detector.matcher_pid is None


def test_widths_that_crash_opencv_are_padded(tmp_path: Path):
    camera = PinholeCamera(331, 257, 420.0, 420.0, 165.0, 128.0)
    with Line2DDetector(bracket(), camera, TINY, tmp_path) as detector:
        assert detector.detect(photograph(bracket(), true_poses(), camera)) is not None
        assert detector.last_report is not None


def test_the_child_matches_three_channels(tmp_path: Path):
    # Line2D reads beyond the pixels of a one-channel image and says nothing
    templates = load_or_train(bracket(), CAMERA, TINY, tmp_path)
    line2d = new_detector(TINY, templates.num_features)
    line2d.readClasses(list(templates.classes), str(templates.folder / "templates_%s.yml.gz"))
    settings = TINY.model_copy(update={"match_threshold": 55.0})
    expected = line2d.match([cv2.cvtColor(_image(), cv2.COLOR_GRAY2BGR)], 55.0)[0]
    matcher = MatcherProcess(templates, settings)
    try:
        found = matcher.match(_image())
    finally:
        matcher.close()
    assert found.total == len(expected) > 0
    np.testing.assert_allclose(found.similarity, [match.similarity for match in expected])
    np.testing.assert_array_equal(found.corner_px, [(match.x, match.y) for match in expected])


def test_templates_are_trained_once(tmp_path: Path):
    pictures: list[tuple[int, int]] = []
    first = load_or_train(bracket(), CAMERA, TINY, tmp_path, lambda done, total: pictures.append((done, total)))
    assert pictures[-1][0] == pictures[-1][1] == len(view_directions(60))
    pictures.clear()
    again = load_or_train(bracket(), CAMERA, TINY, tmp_path, lambda done, total: pictures.append((done, total)))
    assert pictures == []
    np.testing.assert_array_equal(again.axis_R_object, first.axis_R_object)
    assert [entry.name for entry in tmp_path.iterdir()] == [cache_key(bracket(), CAMERA, TINY)]


@pytest.mark.parametrize("name", ["templates_distance_0.yml.gz", "poses.npz", "entry.json"])
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
    assert len(pictures) == len(view_directions(60))
    np.testing.assert_array_equal(again.centre_px, whole.centre_px)


def test_the_key_changes_with_part_camera_and_training_but_not_with_matching():
    key = cache_key(bracket(), CAMERA, TINY)
    assert cache_key(bracket(), CAMERA.scaled(0.5), TINY) != key
    assert cache_key(bracket(), CAMERA, TINY.model_copy(update={"roll_step_deg": 30.0})) != key
    assert cache_key(bracket(), CAMERA, TINY.model_copy(update={"temperature": 1.0})) == key


def test_a_part_too_small_for_templates_is_refused(tmp_path: Path):
    camera = PinholeCamera(320, 256, 40.0, 40.0, 159.5, 127.5)
    with pytest.raises(DetectionError, match="bracket: over 50% of the views offer fewer than 16 features"):
        load_or_train(bracket(), camera, TINY, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_view_directions_cover_the_sphere():
    directions = view_directions(20.0)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    anywhere = np.random.default_rng(0).normal(size=(500, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    assert np.degrees(np.arccos((anywhere @ directions.T).max(axis=1))).max() < 20.0


def test_distances_are_equal_ratios_inside_the_range():
    found = distances(DetectionSettings(distance_m=(0.5, 1.0), distance_ratio=1.2))
    ratios = found[1:] / found[:-1]
    assert found[0] > 0.5
    assert found[-1] < 1.0
    np.testing.assert_allclose(ratios, ratios[0])
    assert ratios[0] <= 1.2


def test_a_pose_on_the_ray_projects_to_the_pixel():
    centre_m = np.array([0.01, -0.02, 0.005])
    pose = pose_on_ray(np.array([40.0, 200.0]), CAMERA, rotation_about((1, 2, 3), 0.4), 0.7, centre_m)
    np.testing.assert_allclose(CAMERA.project(pose[:3, :3] @ centre_m + pose[:3, 3]), [40.0, 200.0], atol=1e-9)


def test_alignment_brings_near_poses_back():
    camera, truth = CAMERA.scaled(2.5), true_poses()[0]
    field = EdgeField(photograph(bracket(), true_poses(), camera))
    starts = np.stack([truth] * 8)
    for seed, start in enumerate(starts):
        axis = np.random.default_rng(seed).normal(size=3)
        start[:3, :3] = rotation_about(axis, np.radians(3)) @ truth[:3, :3]
        start[:3, 3] += (0.001, -0.001, 0.012)
    anywhere_m = np.tile([0.3, 1.5], (len(starts), 1))
    aligned = ContourModel(bracket(), SETTINGS).align(field, camera, starts, anywhere_m)
    turns = [np.degrees(rotation_angle(pose[:3, :3].T @ truth[:3, :3])) for pose in aligned]
    off_px = np.linalg.norm(camera.project(aligned[:, :3, 3]) - camera.project(truth[:3, 3]), axis=1)
    # tilts of a part seen nearly face on are the weak direction: the median, not each
    assert np.median(turns) < 2.0
    assert np.median(off_px) < 1.0
    assert np.median(np.abs(aligned[:, 2, 3] / truth[2, 3] - 1)) < 0.01


@pytest.mark.parametrize(
    ("field", "value"),
    [("num_features", 64), ("match_threshold", 100.0), ("temperature", 0.0), ("distance_m", (0.9, 0.5)), ("typo", 1)],
)
def test_settings_out_of_range_are_refused(field: str, value: object):
    with pytest.raises(ValidationError, match=field):
        DetectionSettings.model_validate({field: value})
