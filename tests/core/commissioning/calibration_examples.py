"""A calibration of each kind, with all numbers made up."""

from __future__ import annotations

from typing import Any

import numpy as np

from sidelong.commissioning.documents import (
    HandEyeDocument,
    LightUsed,
    MaterialDocument,
    NoiseDocument,
    Parameter,
    PoseResidual,
    ProjectorDocument,
    ResponseDocument,
    Scores,
    SensingDocument,
)
from sidelong.physics.depth_noise import DepthNoise
from sidelong.physics.response import Response
from sidelong.physics.sensing import SensingCurve

SERIAL = "N35-1"
IDENTITY = tuple(float(entry) for entry in np.eye(4).ravel())
SURE = Parameter(value=0.5, standard_error=0.01, low=0.48, high=0.52, identifiable=True)
LINEAR = tuple(float(entry) for entry in Response.gamma().log_exposure)


def response_document(**changes: Any) -> ResponseDocument:
    values: dict[str, Any] = {
        "device_serial": SERIAL, "inputs": (), "log_exposure": LINEAR, "standard_error": (0.01,) * 256,
        "exposures_s": (0.001, 0.002, 0.004), "samples": 1000, "condition": 1e4, "residual_rms_ln": 0.01,
        "residual_rms_grey": 0.5, "image_residuals_grey": {"a.bmp": 0.01},
    }  # fmt: skip
    return ResponseDocument(**(values | changes)).sealed()


def material_document(**changes: Any) -> MaterialDocument:
    values: dict[str, Any] = {
        "device_serial": SERIAL, "inputs": (), "material": "stainless", "part": "Tube_fitting",
        "light": LightUsed(intensity=300.0, fall_off=True, vignetting=0.0), "k_d": SURE, "k_s": SURE, "n": SURE,
        "absorbing": False, "samples": 100, "saturated": 0, "dark": 0, "residual_rms_relative": 0.1,
        "residual_rms_grey": 2.0,
    }  # fmt: skip
    return MaterialDocument(**(values | changes)).sealed()


def projector_document(**changes: Any) -> ProjectorDocument:
    values: dict[str, Any] = {
        "device_serial": SERIAL, "inputs": (), "plane_k_d": 0.9, "intensity": SURE.model_copy(update={"value": 200.0}),
        "vignetting": SURE.model_copy(update={"value": 1.5}), "fall_off_exponent": SURE, "samples": 500,
        "residual_rms_relative": 0.01,
    }  # fmt: skip
    return ProjectorDocument(**(values | changes)).sealed()


def sensing_document(**changes: Any) -> SensingDocument:
    curve = SensingCurve(log_exposure=(-4.0, -1.0, 0.5), probability=(0.0, 0.9, 0.2))
    values: dict[str, Any] = {
        "device_serial": SERIAL, "inputs": (), "curve": curve, "views": ("view_0",), "pixels": 1000,
        "light": LightUsed(intensity=300.0, fall_off=True, vignetting=0.0), "held_out": True,
        "scores": Scores(log_loss=0.4, brier=0.1, expected_calibration_error=0.02),
        "exponential_scores": Scores(log_loss=0.7, brier=0.2, expected_calibration_error=0.2),
    }  # fmt: skip
    return SensingDocument(**(values | changes)).sealed()


def noise_document(**changes: Any) -> NoiseDocument:
    values: dict[str, Any] = {
        "device_serial": SERIAL, "inputs": (), "method": "plate", "noise": DepthNoise(disparity_px=0.11, slope_px=0.3),
        "parameters": {"disparity_px": SURE}, "image_px": (1280, 1024), "captures": 5, "pixels": 100_000,
    }  # fmt: skip
    return NoiseDocument(**(values | changes)).sealed()


def hand_eye_document(**changes: Any) -> HandEyeDocument:
    values: dict[str, Any] = {
        "device_serial": SERIAL, "inputs": (), "flange_T_camera": IDENTITY, "base_T_board": IDENTITY, "arm": "ur10e",
        "poses": 12, "smallest_singular_value": 0.3, "residual_rms_px": 0.2,
        "residuals": {"a.bmp": PoseResidual(px=0.2, m=1e-4, rad=1e-4, used=True)},
        "translation_error_m": (2e-4,) * 3, "rotation_error_rad": (1e-4,) * 3,
    }  # fmt: skip
    return HandEyeDocument(**(values | changes)).sealed()
