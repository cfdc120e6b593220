"""Forward and closed-form inverse kinematics of 6-joint arms built like the UR series.

Joints 2, 3 and 4 have parallel axes, joints 1 and 2 as well as 5 and 6 have crossing ones: a target leaves a choice of
two each for shoulder, wrist and elbow. The base frame is the controller's, not that of the ROS description, which is
turned half around z. Lengths are the nominal ones; a factory-calibrated arm differs by 1-2 mm, its controller knows.
Source: K. Hawkins, Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms, Georgia Tech, 2013. Here the
sines come from the target as well, not from the cosines, which keeps the digits where a wrist is nearly straight.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from sidelong.geometry.transforms import invert, validated_transform
from sidelong.types import FloatArray

FORWARD_TOLERANCE = 1e-7
"""Largest difference of an entry (metres, or of a rotation) between a target and the pose its solution leads to."""
WRIST_SINGULAR_SINE = 5e-9
"""Below this sine of joint 5 the target says nothing about joint 6.

At this sine rounding costs joint 6 some 1e-7 rad, and leaving the sine out costs the pose twice the sine: both stay
within ``FORWARD_TOLERANCE`` even where the elbow is stretched and cannot make up for it.
"""

_TWIST_RAD = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
_BRANCHES = np.array(list(itertools.product((1.0, -1.0), repeat=3))).T  # signs of shoulder, wrist, elbow: (3, 8)


@dataclass(frozen=True)
class ArmGeometry:
    """The lengths in an arm's Denavit-Hartenberg table that are not zero, in metres, signs as published."""

    a2_m: float
    a3_m: float
    d1_m: float
    d4_m: float
    d5_m: float
    d6_m: float

    @property
    def a_m(self) -> tuple[float, ...]:
        """Offsets of the six joints along their x axes."""
        return (0.0, self.a2_m, self.a3_m, 0.0, 0.0, 0.0)

    @property
    def d_m(self) -> tuple[float, ...]:
        """Offsets of the six joints along their z axes."""
        return (self.d1_m, 0.0, 0.0, self.d4_m, self.d5_m, self.d6_m)


# Universal Robots, "DH parameters for calculations of kinematics and dynamics"; ur30 from its ROS description
ARMS: Mapping[str, ArmGeometry] = MappingProxyType(
    {
        "ur3": ArmGeometry(-0.24365, -0.21325, 0.1519, 0.11235, 0.08535, 0.0819),
        "ur5": ArmGeometry(-0.425, -0.39225, 0.089159, 0.10915, 0.09465, 0.0823),
        "ur10": ArmGeometry(-0.612, -0.5723, 0.1273, 0.163941, 0.1157, 0.0922),
        "ur3e": ArmGeometry(-0.24355, -0.2132, 0.15185, 0.13105, 0.08535, 0.0921),
        "ur5e": ArmGeometry(-0.425, -0.3922, 0.1625, 0.1333, 0.0997, 0.0996),
        "ur10e": ArmGeometry(-0.6127, -0.57155, 0.1807, 0.17415, 0.11985, 0.11655),
        "ur16e": ArmGeometry(-0.4784, -0.36, 0.1807, 0.17415, 0.11985, 0.11655),
        "ur20": ArmGeometry(-0.862, -0.7287, 0.2363, 0.201, 0.1593, 0.1543),
        "ur30": ArmGeometry(-0.637, -0.5037, 0.2363, 0.201, 0.1593, 0.1543),
    }
)


def forward(arm: ArmGeometry, joints_rad: FloatArray) -> FloatArray:
    """Return ``base_T_flange`` (..., 4, 4) of joint angles (..., 6)."""
    return _chain(arm, joints_rad, range(6))


def inverse(arm: ArmGeometry, base_T_flange: ArrayLike, free_q6_rad: float = 0.0) -> FloatArray:
    """Return every configuration that brings the flange to a pose.

    Parameters
    ----------
    arm
        Its lengths.
    base_T_flange
        (4, 4) target.
    free_q6_rad
        Joint 6 where the target leaves it free: at the wrist singularity (joint 5 at 0 or pi) joints 2, 3, 4 and 6
        turn about parallel axes and a whole curve of configurations leads there. The solutions are those with this
        joint 6, and there may be none although another joint 6 would have some.

    Returns
    -------
    FloatArray
        (N, 6) angles from -pi to pi, N up to 8; each leads to the target within ``FORWARD_TOLERANCE``. (0, 6) where
        the target is out of reach. Where branches meet (stretched elbow, shoulder or wrist singularity) equal rows
        remain.

    Raises
    ------
    PoseError
        The target is not a rigid motion.
    """
    target = validated_transform(base_T_flange, "base_T_flange")
    shoulder, wrist, elbow = _BRANCHES
    with np.errstate(over="ignore"):  # a target at 1e200 m is out of reach, and no more than that
        q1 = _shoulder_angles(arm, target, shoulder)
        q5, q6 = _wrist_angles(target, q1, wrist, free_q6_rad)
        joints_rad = np.stack([q1, *np.zeros((3, 8)), q5, q6], axis=-1)
        joints_rad[:, 1:4] = _planar_angles(arm, target, joints_rad, elbow)
    joints_rad = np.arctan2(np.sin(joints_rad), np.cos(joints_rad))
    # out of reach, the steps above clip to the nearest they can do; only this check tells
    error = np.abs(forward(arm, joints_rad) - target).max(axis=(1, 2))
    return joints_rad[error <= FORWARD_TOLERANCE]


def nearest_turns(joints_rad: FloatArray, near_rad: ArrayLike, low_rad: ArrayLike, high_rad: ArrayLike) -> FloatArray:
    """Shift each joint by full turns to where it is within its limits and nearest to a given configuration.

    Parameters
    ----------
    joints_rad
        (N, 6) configurations.
    near_rad, low_rad, high_rad
        (6,) the given configuration and the limits, inclusive.

    Returns
    -------
    FloatArray
        (M, 6) the shifted configurations, in the same order, without those that have a joint no turn brings within
        its limits.
    """
    turn = 2 * np.pi
    fewest = np.ceil((np.asarray(low_rad) - joints_rad) / turn)
    most = np.floor((np.asarray(high_rad) - joints_rad) / turn)
    nearest = np.round((np.asarray(near_rad) - joints_rad) / turn)
    shifted = joints_rad + turn * np.clip(nearest, fewest, most)
    return shifted[(fewest <= most).all(axis=1)]


def _chain(arm: ArmGeometry, joints_rad: FloatArray, joints: range) -> FloatArray:
    """Return the transform (..., 4, 4) across some of the joints; ``joints_rad`` (..., 6) has all of them."""
    return reduce(np.matmul, [_link(arm, joint, joints_rad[..., joint]) for joint in joints])


def _link(arm: ArmGeometry, joint: int, angle_rad: FloatArray) -> FloatArray:
    """Return the Denavit-Hartenberg transform (..., 4, 4) of one joint at angles (...)."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    cos_twist, sin_twist = np.cos(_TWIST_RAD[joint]), np.sin(_TWIST_RAD[joint])
    link = np.zeros((*np.shape(angle_rad), 4, 4))
    link[..., 0, 0], link[..., 0, 1], link[..., 0, 2] = cos, -sin * cos_twist, sin * sin_twist
    link[..., 1, 0], link[..., 1, 1], link[..., 1, 2] = sin, cos * cos_twist, -cos * sin_twist
    link[..., 2, 1], link[..., 2, 2], link[..., 2, 3] = sin_twist, cos_twist, arm.d_m[joint]
    link[..., 0, 3], link[..., 1, 3] = arm.a_m[joint] * cos, arm.a_m[joint] * sin
    link[..., 3, 3] = 1.0
    return link


def _shoulder_angles(arm: ArmGeometry, target: FloatArray, sign: FloatArray) -> FloatArray:
    """Return joint 1: the wrist's centre is ``d4`` beside the plane in which upper arm and forearm move."""
    x, y, _ = target[:3, 3] - arm.d6_m * target[:3, 2]
    beyond = np.sqrt(max(x * x + y * y - arm.d4_m**2, 0.0))
    return np.arctan2(y, x) + sign * np.arctan2(beyond, arm.d4_m) + np.pi / 2


def _wrist_angles(
    target: FloatArray, q1: FloatArray, sign: FloatArray, free_q6_rad: float
) -> tuple[FloatArray, FloatArray]:
    """Return joints 5 and 6: the normal of that plane, seen in the flange, is (sin5 cos6, -sin5 sin6, cos5)."""
    normal_base = np.stack([np.sin(q1), -np.cos(q1), np.zeros_like(q1)], axis=-1)
    x, y, z = (normal_base @ target[:3, :3]).T
    sine = np.hypot(x, y)
    q6 = np.where(sine < WRIST_SINGULAR_SINE, free_q6_rad, np.arctan2(-sign * y, sign * x))
    return np.arctan2(sign * sine, z), q6


def _planar_angles(arm: ArmGeometry, target: FloatArray, joints_rad: FloatArray, sign: FloatArray) -> FloatArray:
    """Return joints 2, 3 and 4 (8, 3): two links in a plane, then the turn that is left."""
    joint1_T_joint4 = invert(_chain(arm, joints_rad, range(1))) @ target @ invert(_chain(arm, joints_rad, range(4, 6)))
    x, y = joint1_T_joint4[:, 0, 3], joint1_T_joint4[:, 1, 3]
    a2, a3 = arm.a2_m, arm.a3_m
    q3 = sign * np.arccos(np.clip((x * x + y * y - a2 * a2 - a3 * a3) / (2 * a2 * a3), -1.0, 1.0))
    q2 = np.arctan2(y, x) - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
    q4 = np.arctan2(joint1_T_joint4[:, 1, 0], joint1_T_joint4[:, 0, 0]) - q2 - q3
    return np.stack([q2, q3, q4], axis=-1)
