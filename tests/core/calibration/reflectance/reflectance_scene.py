"""Synthetic samples of reflectance with a known truth, for tests and benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.calibration.reflectance.model import ReflectanceSamples, stacked
from sidelong.geometry.transforms import rotation_about
from sidelong.physics.reflectance import Phong, mirrored, radiance, specular

BASELINE_RAD = np.deg2rad(8.0)
WIDEST_RAD = np.deg2rad(75.0)


@dataclass(frozen=True)
class Flaws:
    """What is wrong with a capture: noise in units of the mean light, errors of the normals, saturation, outliers."""

    noise: float = 0.0
    normal_sigma_rad: float = 0.0
    tilt_rad: float = 0.0
    saturation: float = np.inf
    outliers: float = 0.0


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def hemisphere(rng: np.random.Generator, count: int) -> np.ndarray:
    """Normals spread evenly over directions up to 75 degrees off the projector."""
    cosine, turn = rng.uniform(np.cos(WIDEST_RAD), 1.0, count), rng.uniform(0.0, 2.0 * np.pi, count)
    sine = np.sqrt(1.0 - cosine**2)
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1)


def measured_normals(true: np.ndarray, flaws: Flaws, rng: np.random.Generator) -> np.ndarray:
    first = unit(np.cross(true, (0.3, 0.5, 0.9)))
    second = np.cross(true, first)
    noise = flaws.normal_sigma_rad * rng.normal(size=(2, len(true), 1))
    normals = unit(true + noise[0] * first + noise[1] * second)
    if flaws.tilt_rad:
        angle = rng.uniform(0.0, 2.0 * np.pi)
        normals = normals @ rotation_about((np.cos(angle), np.sin(angle), 0.0), flaws.tilt_rad).T
    return normals


def capture(
    material: Phong,
    flaws: Flaws,
    rng: np.random.Generator,
    count: int = 10_000,
    eyes: int = 1,
    normals: np.ndarray | None = None,
) -> ReflectanceSamples:
    """Return samples of a part whose normals cover a hemisphere: projector ahead, each eye 8 degrees beside it."""
    true = hemisphere(rng, count) if normals is None else normals
    count = len(true)
    measured = measured_normals(true, flaws, rng)
    light = rng.uniform(0.5, 1.5, count)
    to_light = np.broadcast_to((0.0, 0.0, 1.0), true.shape)
    parts = []
    for side in (1.0, -1.0)[:eyes]:
        to_camera = np.broadcast_to((side * np.sin(BASELINE_RAD), 0.0, np.cos(BASELINE_RAD)), true.shape)
        exact = radiance(light, (to_light, to_camera), true, material)
        seen = exact + flaws.noise * rng.normal(size=count)
        strays = rng.uniform(size=count) < flaws.outliers
        seen = seen + strays * rng.uniform(0.0, 1.0, count)
        saturated = seen >= flaws.saturation
        facing = ((true @ to_camera[0]) > 0) & ((measured @ to_camera[0]) > 0) & (measured[:, 2] > 0)
        parts.append(
            ReflectanceSamples(
                radiance=np.minimum(seen, flaws.saturation),
                sigma=np.full(count, max(flaws.noise, 1e-6)),
                light=light,
                to_light=to_light,
                to_camera=to_camera,
                normals=measured,
                normal_sigma_rad=np.full(count, flaws.normal_sigma_rad),
                saturated=saturated,
                dark=np.zeros(count, dtype=bool),
                group=np.arange(count),
            )[facing]
        )
    return stacked(parts)


def cosines(samples: ReflectanceSamples) -> tuple[np.ndarray, np.ndarray]:
    """cos theta and cos alpha, as the two-stage fit wants them."""
    cos_theta = np.einsum("ij,ij->i", samples.to_light, samples.normals)
    return cos_theta, np.einsum("ij,ij->i", mirrored(samples.to_light, samples.normals), samples.to_camera)


def shaded(samples: ReflectanceSamples, material: Phong, normals: np.ndarray | None = None) -> np.ndarray:
    """Radiance by the planner's own equations, not by the model under test."""
    at = samples.normals if normals is None else normals
    diffuse = samples.light * np.einsum("ij,ij->i", samples.to_light, at)
    return material.k_d * diffuse + material.k_s * specular(
        samples.light, mirrored(samples.to_light, at), samples.to_camera, material.n
    )
