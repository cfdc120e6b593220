"""Reflectance from samples: do the 95 % intervals hold, and what does a fit cost.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_reflectance.py [--trials 200] [--samples] [--eyes 1 2]

Each trial draws 10,000 points with normals even over directions up to 75 degrees, the projector ahead and a camera 8
degrees beside it (or one on each side), light between 0.5 and 1.5, and noise of that share of the mean light. *Cover*
is how often the stated interval held the truth, in per cent; 95 is nominal, and of 200 trials 91 to 98 is chance
(two standard deviations). *Error* is the median of the relative error of the best fit, *two stages* that of the paper's
method on the same samples, ``-`` where it refused. ``--samples`` varies instead how many samples are used and what the
fit knows: error against run time, a star where nothing faster is better.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1] / "core" / "calibration" / "reflectance"))

from reflectance_scene import Flaws, capture, cosines

from sidelong.calibration.reflectance.fit import ReflectanceSettings, fit_reflectance
from sidelong.calibration.reflectance.model import ReflectanceSamples
from sidelong.calibration.reflectance.two_stages import fit_two_stage
from sidelong.errors import InputError
from sidelong.physics.reflectance import PAPER_MATERIALS, Phong

TWO_DEGREES = float(np.deg2rad(2.0))
CASES = {
    "0.2 %": Flaws(noise=0.002),
    "2 %": Flaws(noise=0.02),
    "2 %, normals 2 deg": Flaws(noise=0.02, normal_sigma_rad=TWO_DEGREES),
    "2 %, tilt 2 deg": Flaws(noise=0.02, tilt_rad=TWO_DEGREES),
}
NAMES = ("n", "k_d", "k_s")
Fit = Callable[[ReflectanceSamples], Phong]


def truth(material: Phong) -> np.ndarray:
    return np.array([material.n, material.k_d, material.k_s])


def two_stages(samples: ReflectanceSamples) -> np.ndarray:
    try:
        phong = fit_two_stage(samples.radiance, samples.light, *cosines(samples))
    except InputError:
        return np.full(3, np.nan)
    return truth(phong)


def coverage(console: Console, trials: int, eyes: list[int]) -> None:
    table = Table(
        "eyes", "noise", "material", *(f"cover {name}" for name in NAMES), *(f"error {name}" for name in NAMES)
    )
    for name in ("n", "k_s"):
        table.add_column(f"two stages {name}")
    table.add_column("n, k_d, k_s identified")
    table.add_column("ms")
    for count in eyes:
        for case, flaws in CASES.items():
            for name, material in PAPER_MATERIALS.items():
                table.add_row(str(count), case, name, *row(material, flaws, trials, count))
    console.print(table)


def row(material: Phong, flaws: Flaws, trials: int, eyes: int) -> list[str]:
    true = truth(material)
    held, identified, elapsed = np.zeros((trials, 3)), np.zeros((trials, 3)), np.zeros(trials)
    error, paper = np.zeros((trials, 3)), np.zeros((trials, 3))
    for trial in range(trials):
        samples = capture(material, flaws, np.random.default_rng(trial), eyes=eyes)
        start = time.perf_counter()
        fit = fit_reflectance(samples)
        elapsed[trial] = time.perf_counter() - start
        parameters = [fit.parameters[name] for name in NAMES]
        held[trial] = [each.low <= value <= each.high for each, value in zip(parameters, true, strict=True)]
        identified[trial] = [each.identified for each in parameters]
        error[trial] = np.abs(truth(fit.phong) / true - 1.0)
        paper[trial] = np.abs(two_stages(samples) / true - 1.0)
    told = ~np.isnan(paper).any(axis=1)
    two = np.median(paper[told], axis=0) if told.any() else np.full(3, np.nan)
    cells = [f"{100 * each:.1f}" for each in held.mean(axis=0)]
    cells += [f"{each:.2%}" for each in np.median(error, axis=0)]
    cells += [f"{two[index]:.0%}" if told.any() else "-" for index in (0, 2)]
    return [
        *cells,
        ", ".join(f"{100 * each:.0f}" for each in identified.mean(axis=0)),
        f"{1e3 * np.median(elapsed):.0f}",
    ]


def methods() -> dict[str, Fit]:
    def fit(blind: bool = False, **settings: float) -> Fit:
        def run(samples: ReflectanceSamples) -> Phong:
            if blind:
                samples = replace(samples, normal_sigma_rad=np.zeros(len(samples)))
            return fit_reflectance(samples, ReflectanceSettings.model_validate(settings)).phong

        return run

    counts = (100, 300, 1000, 2000, 3000, 5000, 10_000)
    return {f"{count} samples": fit(max_samples=count) for count in counts} | {
        "3000, no tilt": fit(tilt_sigma_rad=0.0),
        "3000, normals taken for exact": fit(blind=True),
    }


def samples_against_time(console: Console, trials: int) -> None:
    worst = Flaws(noise=0.02, normal_sigma_rad=TWO_DEGREES, tilt_rad=TWO_DEGREES, outliers=0.03)
    table = Table("method", "rms error ln n", "rms error k_d", "rms error ln k_s", "mean", "ms", "")
    figures: dict[str, tuple[np.ndarray, float]] = {}
    for name, fit in methods().items():
        errors, elapsed = [], []
        for material in (PAPER_MATERIALS["stainless"], PAPER_MATERIALS["plated"]):
            for trial in range(trials):
                samples = capture(material, worst, np.random.default_rng(trial), count=20_000, eyes=2)
                start = time.perf_counter()
                phong = fit(samples)
                elapsed.append(time.perf_counter() - start)
                errors.append(np.log(np.maximum(truth(phong), 1e-3) / truth(material)))
        figures[name] = (np.sqrt(np.mean(np.square(errors), axis=0)), float(np.median(elapsed)))
    for name, (error, seconds) in figures.items():
        beaten = any(other.mean() <= error.mean() and less < seconds for other, less in figures.values())
        cells = [f"{each:.2%}" for each in (*error, error.mean())]
        table.add_row(name, *cells, f"{1e3 * seconds:.0f}", "" if beaten else "*")
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--samples", action="store_true", help="error against run time and number of samples")
    parser.add_argument("--eyes", type=int, nargs="+", default=[1, 2], choices=(1, 2))
    arguments = parser.parse_args()
    console = Console(width=160)
    if arguments.samples:
        samples_against_time(console, arguments.trials)
    else:
        coverage(console, arguments.trials, arguments.eyes)


if __name__ == "__main__":
    main()
