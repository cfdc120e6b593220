"""Equations (10) and (11): what the paper's two stages recover, and what they cannot."""

from __future__ import annotations

import numpy as np
import pytest

from sidelong.calibration.reflectance.two_stages import fit_two_stage
from sidelong.errors import InputError
from sidelong.physics.reflectance import PAPER_MATERIALS, Phong


def samples(material: Phong, count: int = 2000) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    light = random.uniform(0.5, 2.0, count)
    cos_theta = np.cos(random.uniform(0.0, 1.3, count))
    cos_alpha = np.cos(random.uniform(0.0, 2.6, count))
    specular = np.where(cos_alpha > 0, np.abs(cos_alpha) ** material.n, 0.0)
    return light * (material.k_d * cos_theta + material.k_s * specular), light, cos_theta, cos_alpha


@pytest.mark.parametrize("name", sorted(PAPER_MATERIALS))
def test_clean_data_give_back_the_papers_materials(name: str) -> None:
    true = PAPER_MATERIALS[name]
    fit = fit_two_stage(*samples(true))
    assert fit.k_d == pytest.approx(true.k_d, rel=1e-9)
    assert fit.k_s == pytest.approx(true.k_s, rel=1e-3)
    assert fit.n == pytest.approx(true.n, rel=1e-3)


def test_noise_biases_the_second_stage_as_documented() -> None:
    """The docstring warns of it; the robust fit that mends it is another method."""
    radiance, light, cos_theta, cos_alpha = samples(PAPER_MATERIALS["stainless"])
    noisy = radiance + 0.002 * np.random.default_rng(0).normal(size=radiance.size)
    fit = fit_two_stage(noisy, light, cos_theta, cos_alpha)
    assert fit.k_d == pytest.approx(0.037, rel=0.05)
    assert fit.k_s < 0.37


def test_without_normals_beyond_a_right_angle_the_diffuse_share_is_refused() -> None:
    radiance, light, cos_theta, cos_alpha = samples(PAPER_MATERIALS["stainless"])
    near = cos_alpha > 0
    with pytest.raises(InputError, match="0 samples have alpha above pi/2, needs 10: k_d not identifiable"):
        fit_two_stage(radiance[near], light[near], cos_theta[near], cos_alpha[near])


def test_a_perfectly_matte_surface_has_no_glossiness() -> None:
    with pytest.raises(InputError, match=r"not identifiable|no highlight"):
        fit_two_stage(*samples(Phong(k_d=0.4, k_s=0.0, n=1.0)))


def test_samples_at_a_single_angle_do_not_fix_the_glossiness() -> None:
    radiance, light, cos_theta, cos_alpha = samples(PAPER_MATERIALS["stainless"])
    cos_alpha = np.where(cos_alpha > 0, 0.9, cos_alpha)
    with pytest.raises(InputError, match="n not identifiable"):
        fit_two_stage(np.where(cos_alpha > 0, 0.5, radiance), light, cos_theta, cos_alpha)
