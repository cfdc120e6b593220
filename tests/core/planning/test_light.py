"""What the planner believes of materials: known ones, declared ones, and those that need a stand-in."""

from __future__ import annotations

import pytest

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
