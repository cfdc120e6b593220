"""Hand-eye calibration: error against the number of poses and the noise, closed form and both refinements, run time.

    python tests/benchmarks/bench_hand_eye.py [--trials 30] [--images]

A board of 35 corners is seen from 0.6 m by a camera of 1280x1024 (f 1400 px); the arm's poses carry normal noise on
each axis, the corners too. Errors are root mean squares over trials, of the length of the translation's error and of
the angle of the rotation's; *stated* is the same from the standard errors of the refinement. ``--images`` renders each
view instead (grey noise 2 levels, blur 0.7 px) and counts the seconds to find the board.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1] / "core" / "calibration" / "hand_eye"))

from hand_eye_scene import BOARD, CAMERA, Noise, camera_T_board, error, exact_arm, scene, small_motion

from sidelong.calibration.hand_eye.board import render_board
from sidelong.calibration.hand_eye.checks import HandEyeSettings
from sidelong.calibration.hand_eye.solution import HandEye, hand_eye_from_images, solve_hand_eye

POSES = (3, 5, 8, 12, 20, 30)
TILTS_RAD = (0.25, 0.1, 0.05, 0.02)
NOISES = {
    "exact arm": Noise(0.0, 0.0, 0.05),
    "0.1 mrad 0.05 mm": Noise(1e-4, 5e-5, 0.05),
    "0.5 mrad 0.2 mm": Noise(5e-4, 2e-4, 0.05),
    "1 mrad 1 mm": Noise(1e-3, 1e-3, 0.05),
}
METHODS = ("closed form", "corners alone", "arm and corners")


def rms(values: list[tuple[float, float]]) -> tuple[float, float]:
    metres, radians = np.sqrt(np.mean(np.square(values), axis=0))
    return 1e3 * float(metres), float(np.rad2deg(radians))


def rows_of(poses: int, noise: Noise, tilt_rad: float, trials: int) -> list[tuple[str, ...]]:
    """Return a row for each method: error in mm and degrees, stated error, seconds."""
    images, arms = [], []
    seconds = [0.0, 0.0]
    for seed in range(trials):
        observations, arm = scene(poses, seed=seed, noise=noise, tilt_rad=tilt_rad)
        for k, (model, results) in enumerate((("image", images), ("arm", arms))):
            # all poses are sound here: none may be refused or left out by a model that does not expect the arm's noise
            settings = HandEyeSettings(noise=model, max_outlier_share=0.49)
            start = time.perf_counter()
            results.append(solve_hand_eye(observations, list(arm), CAMERA, settings))
            seconds[k] += (time.perf_counter() - start) / trials
    spread = float(np.median([result.spread.least for result in arms]))
    rows = []
    for method, results, second in zip(METHODS, (arms, images, arms), (None, *seconds), strict=True):
        found = [error(r.closed_form if method == METHODS[0] else r.flange_T_camera) for r in results]
        stated = "" if method == METHODS[0] else f"{rms([_stated(result) for result in results])[0]:.3f}"
        mm, deg = rms(found)
        rows.append(
            (method, f"{spread:.2f}", f"{mm:.3f}", stated, f"{deg:.4f}", "" if second is None else f"{second:.3f}")
        )
    return rows


def _stated(result: HandEye) -> tuple[float, float]:
    return float(np.linalg.norm(result.standard_error_m)), float(np.linalg.norm(result.standard_error_rad))


def from_images(poses: int, noise: Noise, trials: int) -> tuple[str, ...]:
    """Return a row for rendered images: error, stated error, seconds for all."""
    found, stated, seconds = [], [], 0.0
    for seed in range(trials):
        random = np.random.default_rng(seed)
        boards = np.stack([camera_T_board(random) for _ in range(poses)])
        arm = [pose @ small_motion(random, noise.arm_rad, noise.arm_m) for pose in exact_arm(boards)]
        images = [render_board(BOARD, CAMERA, pose, noise_grey=2.0, seed=k) for k, pose in enumerate(boards)]
        start = time.perf_counter()
        result = hand_eye_from_images(images, [str(k) for k in range(poses)], arm, CAMERA, BOARD)
        seconds += (time.perf_counter() - start) / trials
        found.append(error(result.flange_T_camera))
        stated.append(_stated(result))
    (mm, deg), (stated_mm, _) = rms(found), rms(stated)
    return "images", "", f"{mm:.3f}", f"{stated_mm:.3f}", f"{deg:.4f}", f"{seconds:.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=30)
    parser.add_argument("--images", action="store_true", help="rendered images, the whole way")
    arguments = parser.parse_args()
    table = Table("noise of the arm", "poses", "method", "spread rad", "error mm", "stated mm", "error deg", "s")
    usual = "0.5 mrad 0.2 mm"
    if arguments.images:
        for poses in (6, 12, 20):
            table.add_row(usual, str(poses), *from_images(poses, NOISES[usual], arguments.trials))
    else:
        cases = [(usual, poses, TILTS_RAD[0]) for poses in POSES]
        cases += [(name, 12, TILTS_RAD[0]) for name in NOISES if name != usual]
        cases += [(usual, 12, tilt) for tilt in TILTS_RAD[1:]]
        for name, poses, tilt in cases:
            for row in rows_of(poses, NOISES[name], tilt, arguments.trials):
                table.add_row(name, str(poses), *row)
            table.add_section()
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
