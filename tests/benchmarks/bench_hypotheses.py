"""How well the probabilities of hypotheses tell right poses from wrong ones, on rendered heaps of shiny parts.

    python tests/benchmarks/bench_hypotheses.py [--parts tube_fitting,gear,part.stl] [--seeds 0,1] [--learn]
                                                [--scenes matte,printed,other,empty,drawn] [--store DIR]

No templates: poses are started from the truth, disturbed by up to half a step between templates; from wrong turns of
the parts that are there; and from the most promising of many random poses anywhere. All are aligned and labelled: right
within 15 degrees modulo symmetry and a quarter of the diameter.

matte, printed   heaps of the part on plain and on strongly textured ground
other            a heap of another part: no pose is right here, nor in the next two
empty            an empty bin, its ground plain and textured in turn
drawn            a flat mosaic of steps, stripes, discs, rings, chequers, ramps and blurred noise of the part's size

With depth and without, for each part and scene:

right      share of the parts at least 60 % visible for which a disturbed pose is right after alignment
P right    median probability of the best right pose of each of these parts, and its lowest tenth
P false    probability that one in a hundred of the poses exceeds which lie on no part
log-lik    mean log-likelihood of the right hypothesis among an object's, at the temperature of the settings
ECE        expected calibration error of these probabilities

``--learn`` fits the coefficients to all parts, and to all but one, prints those of ``plausibility``, the loss and the
calibration error of single poses on the part that was left out, beside those of the shipped coefficients, and the
temperature that maximises its log-likelihood.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_detection import (
    ANGLE_RAD,
    BASE_T_BIN,
    BIN,
    DEPTH_EXPOSURE_S,
    IMAGE_EXPOSURE_S,
    NEAR,
    PARTS_PER_BIN,
    SIZE_PX,
    VISIBLE,
    Case,
    photographed,
)
from scipy import ndimage
from scipy.optimize import minimize, minimize_scalar
from scipy.spatial.transform import Rotation

from sidelong.detection.clusters import distinct, softmax
from sidelong.detection.half_turns import half_turns
from sidelong.detection.plausibility import AT_ZERO, WITH_DEPTH, WITHOUT_DEPTH, probability
from sidelong.detection.proposals import Starts
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.verification import Evidence, Verifier
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part, load_part
from sidelong.geometry.transforms import invert
from sidelong.planning.candidates import DomeSettings, dome_views
from sidelong.simulation.heap import heap
from sidelong.simulation.parts import PART_NAMES, simulated_part
from sidelong.simulation.rig import rig_for
from sidelong.simulation.sensor import ActiveStereoSensor, SensorSettings
from sidelong.types import Projector

DISTURBED, TURNED, ANYWHERE, PROMISING = 4, 5, 1200, 120
HEAPS = ("matte", "printed")
HALF_STEP_RAD, HALF_STEP_RATIO, HALF_STEP_PX = np.radians(10.0), 0.04, 4.0
DISTANCE_RANGE = 1.1
RIDGE = 1e-3
BINS = 10


@dataclass(frozen=True, eq=False)
class Sample:
    """Aligned poses of one scene.

    Attributes
    ----------
    part, scene, visible
        What is looked for in what, and how much (N,) of each part is visible.
    poses
        (K, 4, 4).
    features
        As in ``sidelong.detection.features``.
    owner
        (K,) part that each lies on; -1 for none.
    right
        (K,) whether it is that part's pose.
    """

    part: Part
    scene: str
    visible: np.ndarray
    poses: np.ndarray
    features: Mapping[str, np.ndarray]
    owner: np.ndarray
    right: np.ndarray


def case_of(part: Part, scene: str, seed: int, store: Path | None) -> Case:
    """Render a scene, or read it from the store. Where the part is not, the poses say where to look for it."""
    if scene in HEAPS:
        return photographed(part, scene, seed, store)
    ground = HEAPS[seed % 2]
    if scene == "other":
        known = [name for name in PART_NAMES if name != part.name]
        return photographed(simulated_part(known[seed % len(known)]), ground, seed, store)
    view = dome_views((0.5, 0.0, 0.03), DomeSettings())
    base_T_camera = view[seed % len(view)].base_T_camera
    poses = invert(base_T_camera) @ np.array(heap(part, PARTS_PER_BIN, seed, BASE_T_BIN, BIN))
    if scene == "empty":
        image, depth_m = _empty_bin(ground, seed, base_T_camera, store)
    else:
        distance_m = poses[:, 2, 3]
        image = _mosaic(rig_for(*SIZE_PX).left.fx * part.diameter_m / distance_m.mean(), seed)
        depth_m = distance_m.max()
    return Case(image, np.broadcast_to(depth_m, image.shape), poses, np.zeros(len(poses)))


def _empty_bin(ground: str, seed: int, base_T_camera: np.ndarray, store: Path | None) -> tuple[np.ndarray, np.ndarray]:
    path = None if store is None else store / f"empty_{ground}_{seed}.npz"
    if path is not None and path.is_file():
        with np.load(path) as kept:
            return kept["image"], kept["depth_m"]
    box = BIN.model_copy(update={"material": ground})
    sensor = ActiveStereoSensor(rig_for(*SIZE_PX), [(box.part(), BASE_T_BIN)], SensorSettings())
    image = sensor.capture(base_T_camera, Projector.OFF, IMAGE_EXPOSURE_S, depth=False).left
    depth_m = sensor.capture(base_T_camera, Projector.DOTS, DEPTH_EXPOSURE_S, depth=True).depth_m
    assert depth_m is not None
    if path is not None:
        np.savez_compressed(path, image=image, depth_m=depth_m)
    return image, depth_m


def _mosaic(diameter_px: float, seed: int) -> np.ndarray:
    """Return an image of plain patterns, each on a tile of twice the part's diameter, in camera noise."""
    rng = np.random.default_rng(seed)
    size = int(2 * diameter_px)
    v, u = (np.indices((size, size)) - size / 2) / diameter_px
    image = np.zeros((SIZE_PX[1], SIZE_PX[0]))
    for top in range(0, image.shape[0], size):
        for left in range(0, image.shape[1], size):
            angle, width, dark, bright = rng.uniform((0, 0.15, 10, 90), (np.pi, 0.6, 60, 220))
            across = u * np.cos(angle) + v * np.sin(angle)
            along = v * np.cos(angle) - u * np.sin(angle)
            radius = np.hypot(u, v)
            noise = ndimage.gaussian_filter(rng.normal(size=u.shape), width * diameter_px / 8)
            share = (
                across > 0,
                np.abs(across) < width / 2,
                (np.abs(across) < width / 2) & (np.abs(along) < 0.5),
                radius < width,
                np.abs(radius - 0.4) < width / 4,
                np.floor(across / width) % 2 == np.floor(along / width) % 2,
                across % 1.0,
                0.5 + 0.25 * noise / noise.std(),
            )[rng.integers(8)]
            tile = image[top : top + size, left : left + size]
            tile[:] = (dark + (bright - dark) * np.asarray(share, float))[: tile.shape[0], : tile.shape[1]]
    smooth = ndimage.gaussian_filter(np.clip(image, 0, 255), 0.7)
    return np.clip(rng.poisson(smooth * 8) / 8, 0, 255).astype(np.uint8)


def sampled(part: Part, scene: str, case: Case, verifier: Verifier, depth: bool) -> Sample:
    """Align poses around the truth and anywhere, and label them."""
    camera, rng = rig_for(*SIZE_PX).left, np.random.default_rng(0)
    evidence = Evidence(case.image, case.depth_m if depth else None)
    truths = case.camera_T_objects if scene in HEAPS else np.zeros((0, 4, 4))
    around = [_around(part, camera, pose, rng) for pose in truths[case.visible[: len(truths)] > 0.3]]
    starts = verifier.glance(_bounded(part, np.concatenate([np.zeros((0, 4, 4)), *around])), evidence)[0]
    anywhere, promise = verifier.glance(_bounded(part, _anywhere(part, camera, case, rng)), evidence)
    starts = Starts.joined([starts, anywhere[np.argsort(-promise)[:PROMISING]]])
    found = [verifier.aligned(starts[np.arange(k, min(k + 48, len(starts.poses)))], evidence)
             for k in range(0, len(starts.poses), 48)]  # fmt: skip
    poses = np.concatenate([each[0] for each in found])
    features = {name: np.concatenate([each[2][name] for each in found]) for name in found[0][2]}
    if scene not in HEAPS:
        nothing = np.zeros(len(poses), dtype=bool)
        return Sample(part, scene, np.zeros(0), poses, features, np.full(len(poses), -1), nothing)
    apart, turn_rad = _errors(part, poses, truths)
    owner = np.where(apart.min(axis=1) < NEAR, apart.argmin(axis=1), -1)
    right = (owner >= 0) & (np.take_along_axis(turn_rad, owner[:, None].clip(0), 1)[:, 0] < ANGLE_RAD)
    return Sample(part, scene, case.visible, poses, features, owner, right)


def _around(part: Part, camera: PinholeCamera, pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    axes = rng.normal(size=(DISTURBED, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    near = Rotation.from_rotvec(axes * rng.uniform(0, HALF_STEP_RAD, (DISTURBED, 1))).as_matrix() @ pose[:3, :3]
    far = Rotation.random(TURNED, random_state=rng).as_matrix()
    flipped = pose[:3, :3] @ half_turns(part)[:, :3, :3]
    rotations = np.concatenate([near, far, flipped])
    centre_m = pose[:3, :3] @ part.centre_m + pose[:3, 3]
    centres_m = centre_m * (1 + rng.uniform(-HALF_STEP_RATIO, HALF_STEP_RATIO, (len(rotations), 1)))
    centres_m[:, :2] += rng.uniform(-HALF_STEP_PX, HALF_STEP_PX, (len(rotations), 2)) / camera.fx * centre_m[2]
    return _posed(part, rotations, centres_m)


def _anywhere(part: Part, camera: PinholeCamera, case: Case, rng: np.random.Generator) -> np.ndarray:
    centres_m = case.camera_T_objects[:, :3, :3] @ part.centre_m + case.camera_T_objects[:, :3, 3]
    low, high = centres_m.min(axis=0), centres_m.max(axis=0)
    beside_m = part.diameter_m * np.array([1.0, 1.0, 0.0])
    places = rng.uniform(low - beside_m, high + beside_m, (ANYWHERE, 3))
    return _posed(part, Rotation.random(ANYWHERE, random_state=rng).as_matrix(), places)


def _posed(part: Part, rotations: np.ndarray, centres_m: np.ndarray) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(rotations), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = centres_m - rotations @ part.centre_m
    return poses


def _bounded(part: Part, poses: np.ndarray) -> Starts:
    distance_m = (poses[:, :3, :3] @ part.centre_m + poses[:, :3, 3])[:, 2]
    return Starts(poses, distance_m[:, None] * [1 / DISTANCE_RANGE, DISTANCE_RANGE])


def _errors(part: Part, poses: np.ndarray, truths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far (K, N) poses are from truths sideways, in diameters, and turned, modulo symmetry."""
    here, there = (p[:, :3, :3] @ part.centre_m + p[:, :3, 3] for p in (poses, truths))
    apart = np.linalg.norm(here[:, None, :2] / here[:, None, 2:] - there[:, :2] / there[:, 2:], axis=-1) * there[:, 2]
    turns = [part.symmetry.angle_rad(poses[:, :3, :3], truth[:3, :3]) for truth in truths]
    return apart / part.diameter_m, np.stack(turns, axis=1)


def log_odds_of(model: Mapping[str, float], features: Mapping[str, np.ndarray]) -> np.ndarray:
    """Evaluate any model, as ``plausibility.log_odds`` does its own."""
    return model[AT_ZERO] + sum(w * features[name] for name, w in model.items() if name != AT_ZERO)


def fitted(samples: Sequence[Sample], names: Sequence[str]) -> dict[str, float]:
    """Return the logistic model that fits best. Right and wrong poses count as they come, scenes of a kind alike, and
    those with the part as much as those without."""
    design = np.concatenate([np.stack([np.ones(len(s.right)), *(s.features[n] for n in names)], -1) for s in samples])
    right = np.concatenate([s.right for s in samples]).astype(float)
    kinds = [s.scene in HEAPS for s in samples]
    share = [1 / kinds.count(kind) / len(set(kinds)) for kind in kinds]
    weight = np.concatenate([np.full(len(s.right), w / len(s.right)) for s, w in zip(samples, share, strict=True)])

    def loss(model: np.ndarray) -> tuple[float, np.ndarray]:
        odds = design @ model
        ridge = RIDGE * np.r_[0.0, model[1:]]
        value = float((weight * (np.logaddexp(0, odds) - right * odds)).sum() + 0.5 * ridge @ model)
        return value, design.T @ (weight * (probability(odds) - right)) + ridge

    found = minimize(loss, np.zeros(design.shape[1]), jac=True, method="L-BFGS-B").x
    return dict(zip((AT_ZERO, *names), found.tolist(), strict=True))


def objects_of(sample: Sample, log_odds: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return log-odds and labels of the hypotheses of each object, merged and cut as a detection does."""
    settings = DetectionSettings()
    groups: list[tuple[np.ndarray, np.ndarray]] = []
    for truth in np.flatnonzero(sample.visible >= VISIBLE):
        mine = np.flatnonzero(sample.owner == truth)
        mine = mine[np.argsort(-log_odds[mine])]
        poses = sample.poses[mine]
        step_rad, most = np.radians(settings.pose_step_deg), settings.hypotheses_per_object
        kept = mine[distinct(poses[:, :3, :3], poses[:, 2, 3], step_rad, most, sample.part.symmetry)]
        if sample.right[kept].any():
            groups.append((log_odds[kept], sample.right[kept]))
    return groups


def log_likelihood(groups: list[tuple[np.ndarray, np.ndarray]], temperature: float) -> float:
    """Return the mean log-probability of the right hypotheses of objects."""
    shares = [softmax(odds, temperature)[right].sum() for odds, right in groups]
    return float(np.mean(np.log(np.maximum(shares, 1e-12)))) if shares else np.nan


def calibration_error(groups: list[tuple[np.ndarray, np.ndarray]], temperature: float) -> float:
    """Return the expected calibration error: mean over bins of |share right - mean probability|."""
    if not groups:
        return np.nan
    share = np.concatenate([softmax(odds, temperature) for odds, _ in groups])
    right = np.concatenate([right for _, right in groups])
    return _off_calibration(share, right, np.full(len(share), 1 / len(share)))


def _off_calibration(chance: np.ndarray, right: np.ndarray, weight: np.ndarray) -> float:
    bins = np.minimum((chance * BINS).astype(int), BINS - 1)
    return float(np.abs(np.bincount(bins, weight * (right - chance), BINS)).sum())


def row(samples: Sequence[Sample], model: Mapping[str, float], depth: bool) -> str:
    """Return a line of the table for scenes of one part and ground."""
    best: list[float] = []
    counted = 0
    groups: list[tuple[np.ndarray, np.ndarray]] = []
    false: list[np.ndarray] = []
    for sample in samples:
        odds = log_odds_of(model, sample.features)
        groups += objects_of(sample, odds)
        false.append(probability(odds[sample.owner < 0]))
        for truth in np.flatnonzero(sample.visible >= VISIBLE):
            mine = sample.right & (sample.owner == truth)
            counted += 1
            best += [float(probability(odds[mine]).max())] if mine.any() else []
    lowest, middle = np.quantile(best, [0.1, 0.5]) if best else (np.nan, np.nan)
    temperature = DetectionSettings().temperature
    return (
        f"{samples[0].part.name:14s} {samples[0].scene:8s} {'yes' if depth else 'no':5s} {counted:6d} "
        f"{100 * len(best) / max(counted, 1):6.1f} {middle:7.3f} {lowest:7.3f} "
        f"{np.quantile(np.concatenate(false), 0.99):8.3f} {log_likelihood(groups, temperature):8.3f} "
        f"{calibration_error(groups, temperature):6.3f}"
    )


def learned(samples: Sequence[Sample], shipped: Mapping[str, float]) -> list[str]:
    """Return lines: coefficients, what they are worth on each part that was left out, what temperature changes."""
    names = [name for name in shipped if name != AT_ZERO]
    lines = ["  ".join(f"{name} {weight:.2f}" for name, weight in fitted(samples, names).items())]
    groups: list[tuple[np.ndarray, np.ndarray]] = []
    for part in dict.fromkeys(s.part.name for s in samples):
        model = fitted([s for s in samples if s.part.name != part], names)
        out = [s for s in samples if s.part.name == part]
        even = np.mean([_entropy(float(s.right.mean())) for s in out])
        (loss, off), (loss_shipped, off_shipped) = (_of_poses(out, each) for each in (model, shipped))
        lines.append(
            f"left out {part}: loss {loss:.3f}, of a constant {even:.3f}, shipped {loss_shipped:.3f}; "
            f"ECE {off:.3f}, shipped {off_shipped:.3f}"
        )
        groups += [group for s in out for group in objects_of(s, log_odds_of(model, s.features))]
    best = float(minimize_scalar(lambda t: -log_likelihood(groups, t), bounds=(0.05, 5.0), method="bounded").x)
    lines += [
        f"temperature {t:.2f}: log-likelihood {log_likelihood(groups, t):.3f}, ECE {calibration_error(groups, t):.3f}"
        for t in (1.0, DetectionSettings().temperature, best)
    ]
    return lines


def _of_poses(samples: Sequence[Sample], model: Mapping[str, float]) -> tuple[float, float]:
    """Return the mean loss and the expected calibration error of single poses; scenes count alike."""
    odds = [log_odds_of(model, s.features) for s in samples]
    loss = np.mean([np.mean(np.logaddexp(0, o) - s.right * o) for o, s in zip(odds, samples, strict=True)])
    chance, right = probability(np.concatenate(odds)), np.concatenate([s.right for s in samples])
    weight = np.concatenate([np.full(len(s.right), 1 / len(s.right) / len(samples)) for s in samples])
    return float(loss), _off_calibration(chance, right, weight)


def _entropy(share: float) -> float:
    return -sum(p * np.log(p) for p in (share, 1 - share) if p > 0)


def main() -> int:
    """Print the table, or what was learned."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", default="tube_fitting,hex_screw,eye_bolt,gear", help="simulated parts or CAD files")
    parser.add_argument("--scenes", default="matte,printed,other,empty,drawn")
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--learn", action="store_true", help="fit the model anew, one part left out at a time")
    parser.add_argument("--store", type=Path, default=None, help="keep rendered scenes here")
    options = parser.parse_args()
    seen: dict[bool, list[Sample]] = {True: [], False: []}
    models = {True: WITH_DEPTH, False: WITHOUT_DEPTH}
    sys.stdout.write("part           scene    depth  parts  right P right  lowest  P false  log-lik    ECE\n")
    for name in options.parts.split(","):
        part = load_part(Path(name)) if Path(name).suffix else simulated_part(name)
        verifier = Verifier(part, rig_for(*SIZE_PX).left, DetectionSettings())
        for scene in options.scenes.split(","):
            cases = [case_of(part, scene, int(seed), options.store) for seed in options.seeds.split(",")]
            for depth in (True, False):
                samples = [sampled(part, scene, case, verifier, depth) for case in cases]
                seen[depth] += samples
                sys.stdout.write(row(samples, models[depth], depth) + "\n")
                sys.stdout.flush()
    for depth, samples in seen.items() if options.learn else ():
        sys.stdout.write("\n".join([f"\n{'with' if depth else 'without'} depth", *learned(samples, models[depth]), ""]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
