"""Detection on rendered heaps of shiny parts: what is found, how well, and in what time.

    python tests/benchmarks/bench_detection.py [--parts tube_fitting,gear,part.stl] [--grounds matte,printed]
                                               [--seeds 0,1,2] [--set match_threshold=4 ...] [--no-depth] [--store DIR]
                                               [--proposals]

Each scene is a heap of one part in a bin, seen from a view of the dome at 1280x1024 by the simulated camera: ground and
bin plain (matte) or strongly textured (printed). Counted are the parts of which at least 60 % is unoccluded:

found      an object's best hypothesis is centred within a quarter of the diameter, as the camera sees it
best 10    of those counted, one of the first ten hypotheses of an object so placed is within 15 degrees
top 1      the most probable one is; both modulo the part's symmetry
correct    ADI of the most probable one is below 10 % of the diameter
false      objects per scene that lie on no part at all, however hidden
turn       median angle of the best poses of the correct ones from the truth, degrees; refined: after refinement by the
           depth of the same view
match, s   seconds in the matcher, and beside it those of the rest of the detection; median over scenes

With --proposals, what templates and matching alone are worth, for the same parts:

match 15   a match is centred within a quarter of the diameter and within 15 degrees; 20: within 20 degrees
first n    one of the first n poses of a cluster so placed is within 15 degrees
no match   no template matches there at all; turned: none within 15 degrees; lost: one does, but no cluster has it
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sidelong.detection.depth_evidence import DistanceBounds
from sidelong.detection.detector import TemplateDetector
from sidelong.detection.matcher_process import MatcherProcess, Matches
from sidelong.detection.proposals import Starts, poses_on_rays, propose
from sidelong.detection.refinement import DepthView, Refiner
from sidelong.detection.refinement_settings import RefinementSettings
from sidelong.detection.search_region import searched_image
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.template_cache import load_or_train
from sidelong.detection.templates import TemplateSet
from sidelong.evaluation.pose_errors import PoseMetrics
from sidelong.evaluation.silhouettes import visible_fractions
from sidelong.geometry.mesh import Part, load_part
from sidelong.geometry.transforms import invert, transform
from sidelong.planning.candidates import DomeSettings, dome_views
from sidelong.simulation.bin import Bin
from sidelong.simulation.heap import heap
from sidelong.simulation.parts import simulated_part
from sidelong.simulation.rig import rig_for
from sidelong.simulation.sensor import ActiveStereoSensor, SensorSettings
from sidelong.types import DetectedObject, Projector

SIZE_PX = (1280, 1024)
BIN = Bin(length_m=0.20, width_m=0.16)
BASE_T_BIN = transform(np.eye(3), (0.5, 0.0, 0.0))
PARTS_PER_BIN = 16
VISIBLE = 0.6
NEAR = 0.25
ANGLE_RAD = np.radians(15.0)
CORRECT = 0.1
IMAGE_EXPOSURE_S, DEPTH_EXPOSURE_S = 0.2, 0.012


@dataclass(frozen=True, eq=False)
class Case:
    """What a camera saw of a heap, and the truth: poses (N, 4, 4) in that camera and how much of each is visible."""

    image: np.ndarray
    depth_m: np.ndarray
    camera_T_objects: np.ndarray
    visible: np.ndarray


def photographed(part: Part, ground: str, seed: int, store: Path | None) -> Case:
    """Render a case, or read it from the store."""
    path = None if store is None else store / f"{part.name}_{ground}_{seed}.npz"
    if path is not None and path.is_file():
        with np.load(path) as kept:
            return Case(kept["image"], kept["depth_m"], kept["poses"], kept["visible"])
    rig, views = rig_for(*SIZE_PX), dome_views((0.5, 0.0, 0.03), DomeSettings())
    base_T_camera = views[seed % len(views)].base_T_camera
    box = BIN.model_copy(update={"material": ground})
    base_T_objects = heap(part, PARTS_PER_BIN, seed, BASE_T_BIN, box)
    scene = [(box.part(), BASE_T_BIN), *((part, pose) for pose in base_T_objects)]
    sensor = ActiveStereoSensor(rig, scene, SensorSettings())
    image = sensor.capture(base_T_camera, Projector.OFF, IMAGE_EXPOSURE_S, depth=False).left
    depth_m = sensor.capture(base_T_camera, Projector.DOTS, DEPTH_EXPOSURE_S, depth=True).depth_m
    assert depth_m is not None
    visible = visible_fractions(scene, rig.left, base_T_camera)[1:]
    poses = invert(base_T_camera) @ np.array(base_T_objects)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path, image=image, depth_m=depth_m, poses=poses, visible=visible)
    return Case(image, depth_m, poses, visible)


def turn_of(part: Part, item: DetectedObject, pose: np.ndarray) -> float:
    """Return the angle of an object's best pose from the true one, modulo the symmetry."""
    return float(part.symmetry.angle_rad(item.hypotheses[0].camera_T_object[:3, :3], pose[:3, :3]))


@dataclass
class Tally:
    """Counts over the scenes of one part on one ground."""

    counted: int = 0
    found: int = 0
    best: int = 0
    top: int = 0
    correct: int = 0
    false: int = 0
    scenes: int = 0
    turns_rad: list[float] = field(default_factory=list[float])
    refined_rad: list[float] = field(default_factory=list[float])

    def add(
        self, part: Part, case: Case, objects: tuple[DetectedObject, ...], refined: tuple[DetectedObject, ...]
    ) -> None:
        """Count one scene."""
        self.scenes += 1
        top = np.array([each.hypotheses[0].camera_T_object for each in objects]).reshape(-1, 4, 4)
        here = top[:, :3, :3] @ part.centre_m + top[:, :3, 3]
        there = case.camera_T_objects[:, :3, :3] @ part.centre_m + case.camera_T_objects[:, :3, 3]
        # sideways only: the distance is what a single image knows least
        apart = np.linalg.norm(here[None, :, :2] / here[None, :, 2:] - there[:, None, :2] / there[:, None, 2:], axis=-1)
        near = apart * there[:, None, 2] < NEAR * part.diameter_m
        self.false += int((~near.any(axis=0)).sum())
        metrics = PoseMetrics(part, rig_for(*SIZE_PX).left)
        for truth, pose in enumerate(case.camera_T_objects):
            if case.visible[truth] < VISIBLE:
                continue
            self.counted += 1
            mine = np.flatnonzero(near[truth])
            mine = mine[np.argsort(apart[truth, mine])]
            turns = [
                [part.symmetry.angle_rad(h.camera_T_object[:3, :3], pose[:3, :3]) for h in objects[k].hypotheses[:10]]
                for k in mine
            ]
            self.found += len(mine) > 0
            self.best += any(min(turn) < ANGLE_RAD for turn in turns)
            self.top += any(turn[0] < ANGLE_RAD for turn in turns)
            errors_m = [metrics.deviation(top[k], pose).adi_m for k in mine]
            if min(errors_m, default=np.inf) < CORRECT * part.diameter_m:
                self.correct += 1
                best = mine[int(np.argmin(errors_m))]
                self.turns_rad.append(turn_of(part, objects[best], pose))
                self.refined_rad.append(turn_of(part, refined[best], pose))


@dataclass
class Stages:
    """Counts of how far the truth gets on its way to the verification."""

    FIRST = (1, 4, 10, 40)

    counted: int = 0
    match_15: int = 0
    match_20: int = 0
    first: list[int] = field(default_factory=lambda: [0] * len(Stages.FIRST))
    no_match: int = 0
    lost: int = 0
    matches: int = 0
    capped: int = 0

    def add(self, part: Part, case: Case, matches: Matches, templates: TemplateSet, clusters: list[Starts]) -> None:
        """Count one scene."""
        camera = rig_for(*SIZE_PX).left
        uv = (matches.centre_px + 0.5) * camera.fx / templates.focal_px - 0.5
        self.matches += matches.total
        self.capped += matches.total > len(matches.row)
        for pose in case.camera_T_objects[case.visible >= VISIBLE]:
            self.counted += 1
            centre_m = pose[:3, :3] @ part.centre_m + pose[:3, 3]
            at_px, reach_px = camera.project(centre_m), NEAR * camera.fx * part.diameter_m / centre_m[2]
            near = np.flatnonzero(np.linalg.norm(uv - at_px, axis=1) < reach_px)
            matched = poses_on_rays(
                uv[near], camera, templates.axis_R_object[matches.row[near]], templates.distance_m[matches.row[near]],
                part.centre_m,
            )  # fmt: skip
            turns = part.symmetry.angle_rad(matched[:, :3, :3], pose[:3, :3])
            ranks = [
                rank
                for starts in clusters
                if np.linalg.norm(
                    camera.project(starts.poses[0, :3, :3] @ part.centre_m + starts.poses[0, :3, 3]) - at_px
                )
                < reach_px
                for rank in np.flatnonzero(part.symmetry.angle_rad(starts.poses[:, :3, :3], pose[:3, :3]) < ANGLE_RAD)
            ]
            self.no_match += len(near) == 0
            self.match_15 += bool((turns < ANGLE_RAD).any())
            self.match_20 += bool((turns < np.radians(20.0)).any())
            self.lost += bool((turns < ANGLE_RAD).any()) and not ranks
            self.first = [
                n + (min(ranks, default=10**9) < limit) for n, limit in zip(self.first, self.FIRST, strict=True)
            ]


def proposed(
    part: Part, ground: str, seeds: list[int], settings: DetectionSettings, options: argparse.Namespace
) -> Iterator[str]:
    """Match and cluster in each scene and yield the line of the table."""
    camera, stages, times_s = rig_for(*SIZE_PX).left, Stages(), list[float]()
    cases = [photographed(part, ground, seed, options.store) for seed in seeds]
    reaching = around(cases, settings)
    templates = load_or_train(part, camera, reaching, options.cache)
    matcher = MatcherProcess(templates, reaching)
    matcher.match(np.zeros((64, 64), np.uint8))  # loads the templates
    for case in cases:
        started = time.monotonic()
        matches = matcher.match(searched_image(case.image, camera, templates.focal_px))
        times_s.append(time.monotonic() - started)
        bounds = DistanceBounds(None if options.no_depth else case.depth_m, reaching.reach_m, part.diameter_m)
        stages.add(part, case, matches, templates, propose(matches, templates, bounds, reaching, (part, camera)))
    matcher.close()
    counted = max(stages.counted, 1)
    shares = (
        stages.match_15,
        stages.match_20,
        *stages.first,
        stages.no_match,
        counted - stages.match_15 - stages.no_match,
    )
    figures = " ".join(f"{100 * each / counted:8.1f}" for each in (*shares, stages.lost))
    yield (
        f"{part.name:14s} {ground:8s} {stages.counted:7d} {len(templates.distance_m):9d} {figures} "
        f"{stages.matches // len(cases):9d} {stages.capped:6d} {np.median(times_s):9.2f}"
    )


def row(part: Part, ground: str, tally: Tally, times_s: list[tuple[float, float]]) -> str:
    """Return a line of the table."""
    counted = max(tally.counted, 1)
    shares = [100 * each / counted for each in (tally.found, tally.best, tally.top, tally.correct)]
    match_s, rest_s = np.median(times_s, axis=0)
    figures = " ".join(f"{share:7.1f}" for share in shares)
    return (
        f"{part.name:14s} {ground:8s} {tally.counted:7d} {figures} {tally.false / tally.scenes:6.1f} "
        f"{degrees(tally.turns_rad):5.1f} {degrees(tally.refined_rad):7.1f} "
        f"{match_s:9.2f} {rest_s:6.2f}"
    )


def degrees(angles_rad: list[float]) -> float:
    """Return the median in degrees, NaN of none."""
    return float(np.degrees(np.median(angles_rad))) if angles_rad else float("nan")


def around(cases: list[Case], settings: DetectionSettings) -> DetectionSettings:
    """Return the settings with the distances of the parts."""
    deep = np.concatenate([case.camera_T_objects[:, 2, 3] for case in cases])
    return settings.reaching(float(deep.min()) * 0.97, float(deep.max()) * 1.03)


def measured(
    part: Part, ground: str, seeds: list[int], settings: DetectionSettings, options: argparse.Namespace
) -> Iterator[str]:
    """Detect in each scene and yield the line of the table."""
    tally, times_s = Tally(), list[tuple[float, float]]()
    cases = [photographed(part, ground, seed, options.store) for seed in seeds]
    reaching = around(cases, settings)
    with TemplateDetector(part, rig_for(*SIZE_PX).left, reaching, options.cache) as detector:
        detector.prepare()
        for case in cases:
            objects = detector.detect(case.image, None if options.no_depth else case.depth_m)
            report = detector.last_report
            assert report is not None
            times_s.append((report.match_s, report.align_s))
            refiner = Refiner(part, rig_for(*SIZE_PX).left, RefinementSettings())
            refiner.add(DepthView("reference", case.depth_m, np.eye(4)))
            tally.add(part, case, objects, refiner.refine(objects))
    yield row(part, ground, tally, times_s)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", default="tube_fitting,hex_screw,eye_bolt,gear", help="simulated parts or CAD files")
    parser.add_argument("--grounds", default="matte,printed")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of the detection")
    parser.add_argument("--no-depth", action="store_true", help="detect in the image alone")
    parser.add_argument("--proposals", action="store_true", help="what templates and matching alone are worth")
    parser.add_argument("--store", type=Path, default=None, help="keep rendered scenes here")
    parser.add_argument("--cache", type=Path, default=Path("templates"), help="trained templates")
    options = parser.parse_args()
    changed = {name: json.loads(value) for name, value in (each.split("=", 1) for each in options.set)}
    settings = DetectionSettings.model_validate(changed)
    head = f"{'part':14s} {'ground':8s} counted "
    if options.proposals:
        head += "templates match 15 match 20 " + " ".join(f"{f'first {n}':>8s}" for n in Stages.FIRST)
        head += " no match   turned     lost   matches capped  match, s"
    else:
        head += "  found best 10   top 1 correct  false  turn refined  match, s rest, s"
    sys.stdout.write(head + "\n")
    for name in options.parts.split(","):
        part = load_part(Path(name)) if Path(name).suffix else simulated_part(name)
        for ground in options.grounds.split(","):
            for line in (proposed if options.proposals else measured)(
                part, ground, [int(seed) for seed in options.seeds.split(",")], settings, options
            ):
                sys.stdout.write(line + "\n")
                sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
