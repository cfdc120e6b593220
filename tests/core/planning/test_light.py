"""What the planner believes of materials: known ones, declared ones, and those that need a stand-in."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from sidelong.errors import SettingsError
from sidelong.physics.reflectance import PAPER_MATERIALS, Phong
from sidelong.planning.light import LightSettings, MaterialSettings
from sidelong.recipe import Recipe, build_stages
from sidelong.simulation.parts import simulated_part
from sidelong.simulation.rig import rig_for

BRASS = MaterialSettings(k_d=0.1, k_s=0.6, n=30.0)


def test_materials_come_in_the_order_asked_for():
    light = LightSettings(materials={"brass": BRASS})
    assert light.reflectances(("matte", "brass")) == (PAPER_MATERIALS["matte"], Phong(0.1, 0.6, 30.0))


def test_a_declared_material_goes_before_the_papers():
    assert LightSettings(materials={"matte": BRASS}).reflectances(("matte",)) == (Phong(0.1, 0.6, 30.0),)


def test_an_unknown_material_is_taken_for_the_stand_in_and_named():
    light = LightSettings(stand_in="plated")
    assert light.reflectances(("bronze",)) == (PAPER_MATERIALS["plated"],)
    assert light.unknown(("bronze", "matte")) == ("bronze",)


@pytest.mark.parametrize("stand_in", [None, "unobtainium"])
def test_without_a_stand_in_an_unknown_material_is_refused(stand_in: str | None):
    with pytest.raises(SettingsError, match=r"'bronze'.*known are black_plastic, matte, plated, stainless"):
        LightSettings(stand_in=stand_in).reflectances(("bronze",))


def test_the_stages_say_for_which_material_something_stands_in(tmp_path):
    part = simulated_part("tube_fitting")
    bronze = type(part)(part.name, part.vertices_m, part.triangles, part.triangle_material, ("bronze",))
    with build_stages(Recipe(), bronze, rig_for(320, 256), tmp_path, objects=()) as stages:
        assert "reflectance of bronze: left out, none is known, stainless stands in" in stages.left_out


TABLE = tuple(np.log((np.arange(256) + 0.5) / 255.5).tolist())


def test_a_response_table_goes_before_gamma_and_its_scale_does_not_matter():
    for shift in (0.0, 3.0):
        response = LightSettings(gamma=2.2, response_table=tuple(g + shift for g in TABLE)).response()
        assert response.saturation_exposure == pytest.approx(1.0)
        np.testing.assert_allclose(response.log_exposure, TABLE, atol=1e-12)
    assert LightSettings(gamma=2.2).response().log_exposure[128] == pytest.approx(2.2 * np.log(128 / 255))


def test_a_response_table_survives_json_to_the_bit():
    light = LightSettings(response_table=TABLE, vignetting=3.0)
    assert LightSettings.model_validate_json(light.model_dump_json()) == light
    assert Recipe.model_validate(Recipe(light=light).model_dump(mode="json")).light == light


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (TABLE[:-1], "at least 256"),
        ((*TABLE, 1.0), "at most 256"),
        ((*TABLE[:7], float("nan"), *TABLE[8:]), "finite"),
        ((*TABLE[:7], TABLE[6], *TABLE[8:]), "at Z = 6 to .* at Z = 7, it must everywhere"),
    ],
)
def test_a_table_that_is_none_is_refused_with_the_place(table: tuple[float, ...], words: str):
    with pytest.raises(ValidationError, match=rf"response_table[\s\S]*{words}"):
        LightSettings(response_table=table)


@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf"), True])
def test_vignetting_out_of_range_is_refused(value: float):
    with pytest.raises(ValidationError, match="vignetting"):
        LightSettings(vignetting=value)


def test_light_stored_before_there_was_vignetting_is_read():
    stored = LightSettings.model_validate_json('{"gamma": 1.0, "materials": {"x": {"k_d": 0.1, "k_s": 0.2, "n": 3.0}}}')
    assert (stored.vignetting, stored.response_table, stored.materials["x"].absorbing) == (0.0, None, False)


def test_the_stages_say_that_vignetting_is_left_out_and_only_where_it_is(tmp_path):
    part = simulated_part("tube_fitting")
    term = "projector vignetting: left out, light.vignetting is 0"
    for power in (0.0, 2.0):
        recipe = Recipe(light=LightSettings(vignetting=power))
        with build_stages(recipe, part, rig_for(320, 256), tmp_path, objects=()) as stages:
            assert (term in stages.left_out) is (power == 0.0)
            assert stages.light.vignetting == power
