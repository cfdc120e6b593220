"""Calibrations in the settings of a scan: they go before presets, and only where they fit device and each other."""

from __future__ import annotations

import numpy as np
import pytest
from calibration_examples import (
    SERIAL,
    hand_eye_document,
    material_document,
    noise_document,
    projector_document,
    response_document,
    sensing_document,
)

from sidelong.commissioning.applied import calibrated, calibrated_mount
from sidelong.commissioning.documents import LightUsed, Parameter
from sidelong.errors import CalibrationError
from sidelong.recipe import Recipe

RECIPE = Recipe()


def test_without_calibrations_a_recipe_stays_as_it_is() -> None:
    assert calibrated(RECIPE, (), SERIAL) is RECIPE


def test_each_calibration_goes_before_its_preset_and_is_named() -> None:
    response, projector = response_document(), projector_document()
    documents = response, projector, sensing_document(uses=(response.id, projector.id))
    recipe = calibrated(RECIPE, documents, SERIAL)
    np.testing.assert_array_equal(recipe.light.response().log_exposure, documents[0].log_exposure)
    assert (recipe.light.intensity, recipe.light.vignetting) == (200.0, 1.5)
    assert recipe.sensing.curve == documents[2].curve
    assert recipe.calibrations == tuple(document.id for document in documents)
    assert Recipe.model_validate_json(recipe.model_dump_json()) == recipe


def test_applying_twice_changes_nothing_more() -> None:
    documents = response_document(), material_document()
    once = calibrated(RECIPE, documents, SERIAL)
    assert calibrated(once, documents, SERIAL) == once


def test_a_material_brings_the_light_it_was_fitted_in() -> None:
    light = LightUsed(intensity=420.0, fall_off=False, vignetting=2.0)
    recipe = calibrated(RECIPE, [material_document(light=light)], SERIAL)
    assert (recipe.light.intensity, recipe.light.fall_off, recipe.light.vignetting) == (420.0, False, 2.0)
    assert recipe.light.materials["stainless"].k_d == 0.5


def test_under_another_intensity_only_the_product_stays() -> None:
    light = LightUsed(intensity=300.0, fall_off=True, vignetting=1.5)
    recipe = calibrated(RECIPE, [material_document(light=light), projector_document()], SERIAL)
    assert recipe.light.intensity == 200.0
    material = recipe.light.materials["stainless"]
    assert material.k_d * 200.0 == pytest.approx(0.5 * 300.0)
    assert material.k_s * 200.0 == pytest.approx(0.5 * 300.0)
    assert material.n == 0.5


def test_noise_goes_to_the_fusion_and_stands_by_itself() -> None:
    document = noise_document()
    recipe = calibrated(RECIPE, [document], SERIAL)
    assert recipe.fusion.noise == document.noise
    assert recipe.fusion.model_copy(update={"noise": RECIPE.fusion.noise}) == RECIPE.fusion
    assert recipe.light == RECIPE.light
    assert calibrated(RECIPE, [document, sensing_document()], SERIAL).fusion == recipe.fusion
    with pytest.raises(CalibrationError, match="are both of noise: name one of them"):
        calibrated(RECIPE, [document, noise_document(method="repeats")], SERIAL)


def test_materials_do_not_push_out_others() -> None:
    recipe = calibrated(RECIPE, [material_document(), material_document(material="black_plastic")], SERIAL)
    assert set(recipe.light.materials) == {"stainless", "black_plastic"}


def test_an_absorbing_material_is_known_to_give_no_depth() -> None:
    recipe = calibrated(RECIPE, [material_document(absorbing=True)], SERIAL)
    (reflectance,) = recipe.light.reflectances(("stainless",))
    assert (reflectance.k_d, reflectance.k_s) == (0.0, 0.0)


def test_a_hand_eye_calibration_goes_before_the_configured_mount() -> None:
    mount = np.eye(4)
    mount[:3, 3] = (0.1, 0.0, 0.0)
    assert calibrated_mount(mount, ()) is mount
    np.testing.assert_array_equal(calibrated_mount(mount, [hand_eye_document()]), np.eye(4))


@pytest.mark.parametrize("serial", ["N35-2", "", "unknown"])
def test_a_calibration_of_another_device_is_refused(serial: str) -> None:
    with pytest.raises(CalibrationError, match=f"is of device 'N35-1', the camera is '{serial}'"):
        calibrated(RECIPE, [response_document()], serial)


def test_two_of_a_kind_are_refused() -> None:
    documents = response_document(), response_document(samples=7)
    with pytest.raises(CalibrationError, match=r"are both of response: name one of them"):
        calibrated(RECIPE, documents, SERIAL)
    with pytest.raises(CalibrationError, match=r"are both of material stainless"):
        calibrated(RECIPE, [material_document(), material_document(samples=7)], SERIAL)


def test_a_calibration_needs_those_it_was_made_with() -> None:
    response = response_document()
    material = material_document(uses=(response.id,))
    with pytest.raises(CalibrationError, match=f"was made with {response.id}, which is not named beside it"):
        calibrated(RECIPE, [material], SERIAL)
    assert calibrated(RECIPE, [material, response], SERIAL).light.response_table is not None


def test_a_curve_brings_the_light_it_was_learned_in() -> None:
    light = LightUsed(intensity=590.0, fall_off=True, vignetting=0.5)
    recipe = calibrated(RECIPE, [sensing_document(light=light)], SERIAL)
    assert (recipe.light.intensity, recipe.light.vignetting) == (590.0, 0.5)


def test_a_curve_that_was_learned_in_another_light_is_refused() -> None:
    response = response_document()
    with pytest.raises(CalibrationError, match=f"was learned without {response.id}, and exposures change with it"):
        calibrated(RECIPE, [response, sensing_document()], SERIAL)


def test_a_material_that_was_fitted_in_another_light_is_refused() -> None:
    light = LightUsed(intensity=300.0, fall_off=True, vignetting=0.0)
    with pytest.raises(CalibrationError, match=r"was fitted with light\.vignetting 0\.0, the scan has 1\.5: fit it"):
        calibrated(RECIPE, [material_document(light=light), projector_document()], SERIAL)


def test_a_name_without_its_calibration_is_refused() -> None:
    recipe = Recipe(calibrations=("response-0123456789ab",))
    with pytest.raises(CalibrationError, match=r"recipe\.calibrations: names response-0123456789ab"):
        calibrated(recipe, [sensing_document()], SERIAL)


def test_a_number_that_could_not_be_identified_is_used_as_stated() -> None:
    unsure = Parameter(value=8.0, standard_error=None, low=0.0, high=100.0, identifiable=False, note="matte")
    recipe = calibrated(RECIPE, [material_document(n=unsure)], SERIAL)
    assert recipe.light.materials["stainless"].n == 8.0
