"""Detection of a rendered bracket: poses, the template cache, bad images, a matcher that dies."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from detection_scene import CAMERA, bracket, photograph, true_poses
from pydantic import ValidationError

from sidelong.detection.alignment import Aligner
from sidelong.detection.appearance import AppearanceModel
from sidelong.detection.contours import ContourModel, EdgeField
from sidelong.detection.detector import TemplateDetector
from sidelong.detection.settings import DetectionSettings
from sidelong.errors import ImageError, MatcherDiedError
from sidelong.geometry.transforms import rotation_about, rotation_angle
from sidelong.types import FloatArray

SETTINGS = DetectionSettings(view_step_deg=30, roll_step_deg=20, distance_m=(0.65, 0.75), span_px=48)
TINY = DetectionSettings(view_step_deg=60, roll_step_deg=60, distance_m=(0.7, 0.7), span_px=48)
DARK = np.full((CAMERA.height, CAMERA.width), 20, dtype=np.uint8)


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TemplateDetector]:
    with TemplateDetector(bracket(), CAMERA, SETTINGS, tmp_path_factory.mktemp("templates")) as made:
        made.prepare()
        yield made


def _image() -> np.ndarray:
    return photograph(bracket(), true_poses(), CAMERA)


def _off_px(pose: FloatArray, truth: FloatArray) -> float:
    return float(np.linalg.norm(CAMERA.project(pose[:3, 3]) - CAMERA.project(truth[:3, 3])))


def test_both_parts_are_found_where_they_are(detector: TemplateDetector):
    objects = detector.detect(_image())
    assert len(objects) == 2
    for truth in true_poses():
        near = min(objects, key=lambda found: _off_px(found.hypotheses[0].camera_T_object, truth))
        assert _off_px(near.hypotheses[0].camera_T_object, truth) < 3.0
        # of a part that spans 40 pixels, one image tells the distance to 5 % or so, and tilts no better
        right = [
            pose
            for pose in (h.camera_T_object for h in near.hypotheses)
            if np.degrees(rotation_angle(pose[:3, :3].T @ truth[:3, :3])) < 15.0
            and abs(pose[2, 3] / truth[2, 3] - 1) < 0.06
        ]
        assert right


def test_hypotheses_come_ranked_with_probabilities_of_one(detector: TemplateDetector):
    for found in detector.detect(_image()):
        probabilities = [h.probability for h in found.hypotheses]
        scores = [h.score for h in found.hypotheses]
        assert sum(probabilities) == pytest.approx(1.0)
        assert scores == sorted(scores, reverse=True)
        assert all(0 <= score <= 100 for score in scores)
        assert len(found.hypotheses) <= SETTINGS.hypotheses_per_object


def test_the_report_says_what_was_done(detector: TemplateDetector):
    detector.detect(_image())
    report = detector.last_report
    assert report is not None
    assert report.matches >= report.matches_kept > 0
    assert report.match_s > 0


@pytest.mark.parametrize("level", [0, 20, 255])
def test_a_blank_image_holds_no_object(detector: TemplateDetector, level: int):
    assert detector.detect(np.full_like(DARK, level)) == ()


def test_noise_holds_no_object(detector: TemplateDetector):
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
def test_wrong_images_are_refused(detector: TemplateDetector, image: np.ndarray, message: str):
    with pytest.raises(ImageError, match=message):
        detector.detect(image)


def test_a_matcher_that_was_killed_is_an_error_and_the_next_call_works(detector: TemplateDetector):
    expected = len(detector.detect(_image()))
    pid = detector.matcher_pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(MatcherDiedError, match="ended with code -9"):
        detector.detect(_image())
    assert len(detector.detect(_image())) == expected
    assert detector.matcher_pid != pid


def test_close_ends_the_child_and_may_be_repeated(tmp_path: Path):
    detector = TemplateDetector(bracket(), CAMERA, TINY, tmp_path)
    detector.detect(_image())
    pid = detector.matcher_pid
    assert pid is not None
    detector.close()
    detector.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_alignment_brings_near_poses_back():
    camera, truth = CAMERA.scaled(2.5), true_poses()[0]
    field = EdgeField(photograph(bracket(), true_poses(), camera))
    starts = np.stack([truth] * 8)
    for seed, start in enumerate(starts):
        axis = np.random.default_rng(seed).normal(size=3)
        start[:3, :3] = rotation_about(axis, np.radians(3)) @ truth[:3, :3]
        start[:3, 3] += (0.001, -0.001, 0.012)
    anywhere_m = np.tile([0.3, 1.5], (len(starts), 1))
    aligner = Aligner(bracket(), camera, ContourModel(bracket(), SETTINGS), AppearanceModel(bracket(), camera), 1.12)
    aligned = aligner.align(starts, anywhere_m, field, None)
    turns = [np.degrees(rotation_angle(pose[:3, :3].T @ truth[:3, :3])) for pose in aligned]
    off_px = np.linalg.norm(camera.project(aligned[:, :3, 3]) - camera.project(truth[:3, 3]), axis=1)
    # tilts of a part seen nearly face on are the weak direction: the median, not each
    assert np.median(turns) < 2.0
    assert np.median(off_px) < 1.0
    assert np.median(np.abs(aligned[:, 2, 3] / truth[2, 3] - 1)) < 0.01


@pytest.mark.parametrize(
    ("field", "value"),
    [("cell_px", 1), ("match_threshold", 100.0), ("temperature", 0.0), ("distance_m", (0.9, 0.5)), ("typo", 1)],
)
def test_settings_out_of_range_are_refused(field: str, value: object):
    with pytest.raises(ValidationError, match=field):
        DetectionSettings.model_validate({field: value})
