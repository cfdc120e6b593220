"""Response from an exposure bracket: error against run time, beside OpenCV's CalibrateDebevec on the same images.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_response.py [--quick] [--recorded FOLDER]

Nine images of 1280x1024 with 1 grey level of noise, by three known responses, of a scene with all shades and of one
that is dark but for a few spots. Errors are of g at levels 1 to 254 after both are aligned by the median difference, so
that neither gains by its choice of scale. *all* is the time from images to result, choice of samples and checks
included; *solve* the fit to samples already chosen; *once* a single elimination and solution, as OpenCV's is. Times are
CPU time of one thread, the least of some repeats, ours and OpenCV's in turn: ratios then hold on a busy machine.
``--recorded`` fits a folder of images with ``times.json`` ({"unit": "ms", "times": {name: time}}).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from sidelong.calibration.response.curve import fit_curve
from sidelong.calibration.response.fit import fit_response
from sidelong.calibration.response.radiance_map import merge_bracket
from sidelong.calibration.response.samples import choose_samples, draw_pool, read_bracket
from sidelong.calibration.response.solve import eliminate, solve_rising
from sidelong.errors import CalibrationError
from sidelong.physics.response import LEVELS

SHAPE = (1024, 1280)
TIMES_S = 0.00025 * 2.0 ** np.arange(9)
NOISE_GREY = 1.0
DEFAULT_GRID = 70
OPENCV_LAMBDA = 10.0
CONSOLE = Console(width=110)


def knee(x: np.ndarray) -> np.ndarray:
    steep = (0.3 + 0.7 * 0.25) / 0.25
    return np.where(x < 0.7 / steep, steep * x, 0.7 + 0.25 * steep * (x - 0.7 / steep))


CURVES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "gamma 2.2": lambda x: x ** (1 / 2.2),
    "knee": knee,
    "S": lambda x: 1.25 * x**1.4 / (x**1.4 + 0.25),
}


@dataclass(frozen=True, eq=False)
class Case:
    """One bracket: images, the true g, and names for the table."""

    scene: str
    curve: str
    images: np.ndarray
    true_g: np.ndarray


def radiance_of(scene: str, random: np.random.Generator) -> np.ndarray:
    """Radiance (H, W) in saturation exposures per second."""
    rough = [cv2.GaussianBlur(random.normal(size=SHAPE), (0, 0), s) for s in (60, 8)]
    coarse, fine = (r / r.std() for r in rough)
    if scene == "all shades":
        return 20 * np.exp(1.2 * coarse + 0.5 * fine)
    radiance = 0.7 * np.exp(0.3 * coarse + 0.1 * fine)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    for _ in range(6):
        at, width = random.uniform(0.1, 0.9, 2) * SHAPE, random.uniform(9, 27)
        spot = np.exp(-((y - at[0]) ** 2 + (x - at[1]) ** 2) / (2 * width**2))
        radiance += random.uniform(30, 300) * spot
    return radiance


def case_of(scene: str, curve: str, seed: int) -> Case:
    random = np.random.default_rng(seed)
    radiance, f = radiance_of(scene, random), CURVES[curve]
    images: list[np.ndarray] = []
    for time_s in TIMES_S:
        x = radiance * time_s
        z = 255 * (f(np.minimum(x, 1)) + np.clip(x - 1, 0, 1)) + NOISE_GREY * random.normal(size=SHAPE)
        images.append(np.clip(np.rint(z), 0, 255).astype(np.uint8))
    x = np.linspace(-15.0, 0.0, 200_001)
    true_g = np.interp(np.r_[0.5, np.arange(1.0, LEVELS)], 255 * f(np.exp(x)), x)
    return Case(scene, curve, np.array(images), true_g)


def errors_of(g: np.ndarray, case: Case) -> tuple[float, float]:
    """Median and largest error of levels 1 to 254, aligned by the median."""
    difference = (g - case.true_g)[1:-1]
    errors = np.abs(difference - np.median(difference))
    return float(np.median(errors)), float(errors.max())


def opencv(case: Case, samples: int, random: bool = False) -> np.ndarray:
    calibrate = cv2.createCalibrateDebevec(samples, OPENCV_LAMBDA, random)
    return np.log(calibrate.process(list(case.images), TIMES_S.astype(np.float32)).ravel().astype(np.float64))


def sampled(case: Case, samples: int) -> np.ndarray:
    bracket = read_bracket(case.images, TIMES_S)
    return choose_samples(bracket, draw_pool(bracket, 0), samples, 0).grey


def solve_alone(grey: np.ndarray) -> object:
    fit = fit_curve(grey, TIMES_S)
    return solve_rising(fit.normal, fit.solution.smoothness)


def solve_once(grey: np.ndarray) -> object:
    weights = np.minimum(grey, LEVELS - 1 - grey).astype(np.float64)
    return solve_rising(eliminate(grey, np.broadcast_to(np.log(TIMES_S), grey.shape), weights), 1e9)


def alternating_s(runs: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Least CPU seconds of each of the runs, taken in turn; those below 0.2 s five times a turn."""
    least = dict.fromkeys(runs, np.inf)
    for _ in range(repeats):
        for name, run in runs.items():
            for _ in range(5 if least[name] < 0.2 else 1):
                start = time.process_time()
                run()
                least[name] = min(least[name], time.process_time() - start)
    return least


def show_speed(case: Case, repeats: int) -> None:
    columns = ("samples", "OpenCV ms", "all ms", "ratio", "solve ms", "ratio", "once ms", "ratio")
    table = Table(*columns, title="run time against OpenCV's")
    for samples in (DEFAULT_GRID, 400, 1000):
        grey = sampled(case, samples)
        runs: dict[str, Callable[[], object]] = {
            "opencv": partial(opencv, case, samples),
            "all": partial(fit_response, case.images, TIMES_S, samples=samples),
            "solve": partial(solve_alone, grey),
            "once": partial(solve_once, grey),
        }
        least = alternating_s(runs, repeats)
        row = [str(samples), f"{1e3 * least['opencv']:.0f}"]
        for ours in ("all", "solve", "once"):
            row += [f"{1e3 * least[ours]:.1f}", f"{least['opencv'] / least[ours]:.0f}"]
        table.add_row(*row)
    CONSOLE.print(table)


def show_sweep(cases: list[Case], counts: tuple[int, ...], opencv_counts: tuple[int, ...]) -> None:
    """Error against run time: geometric means over the cases of each scene."""
    rows: dict[str, dict[str, list[tuple[float, float, float]]]] = {}
    for case in cases:
        for samples in counts:
            fit_response(case.images, TIMES_S, samples=samples)
            start = time.process_time()
            try:
                g = fit_response(case.images, TIMES_S, samples=samples).response.log_exposure
            except CalibrationError:
                continue  # too few samples to cover the levels: refused, not wrong
            spent = time.process_time() - start
            rows.setdefault(f"sidelong {samples}", {}).setdefault(case.scene, []).append((*errors_of(g, case), spent))
        for samples in opencv_counts:
            for random in (False, True):
                start = time.process_time()
                g = opencv(case, samples, random)
                spent = time.process_time() - start
                name = f"OpenCV {samples} {'random' if random else 'grid'}"
                rows.setdefault(name, {}).setdefault(case.scene, []).append((*errors_of(g, case), spent))
    scenes = list(dict.fromkeys(case.scene for case in cases))
    table = Table(
        "method, samples",
        *["median", "max", "ms", "fits"] * len(scenes),
        title=f"error of g (ln units) and run time, geometric means, {len(cases) // len(scenes)} brackets: "
        + "; ".join(scenes),
    )
    for name, by_scene in rows.items():
        cells: list[str] = []
        for scene in scenes:
            got = np.array(by_scene.get(scene, [(np.nan, np.nan, np.nan)]))
            median, largest, spent = np.exp(np.log(got).mean(axis=0))
            cells += [f"{median:.4f}", f"{largest:.3f}", f"{1e3 * spent:.0f}", str(len(by_scene.get(scene, [])))]
        table.add_row(name, *cells)
    CONSOLE.print(table)


def show_ends(cases: list[Case]) -> None:
    """How well the two extrapolated levels come out, against mid-grey."""
    table = Table(
        "response", "g(255) error", "stated", "g(0) error", title="extrapolated ends, ln units, worst bracket"
    )
    for curve in CURVES:
        fits = [(fit_response(case.images, TIMES_S), case) for case in cases if case.curve == curve]
        off = np.array([(f.response.log_exposure - c.true_g)[[128, 0]] for f, c in fits])
        stated = max(f.standard_error[128] for f, _ in fits)
        black = np.abs(off[:, 1] - off[:, 0]).max()
        table.add_row(curve, f"{np.abs(off[:, 0]).max():.4f}", f"{stated:.4f}", f"{black:.3f}")
    CONSOLE.print(table)


def show_recorded(folder: Path) -> None:
    listed = json.loads((folder / "times.json").read_text())
    scale = {"ms": 1e-3, "s": 1.0}[listed["unit"]]
    names = list(listed["times"])
    images = [cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED) for name in names]
    times_s = np.array([listed["times"][name] for name in names]) * scale
    fit = fit_response(images, times_s, names)
    table = Table("image", "residual, grey levels", "equations", title=str(folder.name))
    for name, residual, count in zip(fit.names, fit.image_residual_grey, fit.image_equations, strict=True):
        table.add_row(name, f"{residual:.2f}", str(count))
    CONSOLE.print(table)
    CONSOLE.print(
        f"noise {fit.noise_grey:.2f} grey levels, rms {fit.residual_ln:.3f} ln units, condition {fit.condition:.1e}, "
        f"{fit.shapes:.1f} shapes, levels seen {fit.coverage.share_seen:.1%}, moved to rise {fit.correction:.2g}, "
        f"warnings {list(fit.warnings)}"
    )
    g, z = fit.response.log_exposure, np.array([5, 20, 50, 100, 150, 200, 250])
    exponents = (g[z + 4] - g[z - 4]) / np.log((z + 4) / (z - 4))
    text = ", ".join(f"{level}: {e:.2f}" for level, e in zip(z, exponents, strict=True))
    CONSOLE.print(f"local gamma d g / d ln z at grey level {text}")
    merged = merge_bracket(images, times_s, fit.response)
    CONSOLE.print(
        f"radiance map: residual median {np.nanmedian(merged.residual_grey):.2f}, 99 % below "
        f"{np.nanquantile(merged.residual_grey, 0.99):.2f} grey levels, saturated in all "
        f"{merged.saturated.mean():.2%}, dark in all {merged.dark.mean():.2%}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one seed, fewer counts")
    parser.add_argument("--recorded", type=Path, help="folder of images with times.json")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.recorded:
        show_recorded(options.recorded)
        return
    seeds = range(1 if options.quick else 3)
    cases = [
        case_of(scene, curve, seed) for scene in ("all shades", "mostly dark") for curve in CURVES for seed in seeds
    ]
    show_speed(cases[0], 2 if options.quick else 5)
    counts = (200, 1000, 5000) if options.quick else (50, 100, 200, 500, 1000, 2000, 3000, 5000, 10_000)
    show_sweep(cases, counts, (DEFAULT_GRID, 1000) if options.quick else (DEFAULT_GRID, 400, 1000))
    show_ends(cases)


if __name__ == "__main__":
    main()
