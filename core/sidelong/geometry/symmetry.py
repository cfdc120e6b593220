"""Turns of a part that map it onto itself: poses that differ by one of them show the same.

An operation ``object_T_object`` of the part takes a pose ``a_T_object`` to ``a_T_object @ object_T_object``. All
operations leave ``centre_m`` where it is, so equivalent poses differ in orientation alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sidelong.errors import SettingsError
from sidelong.geometry.transforms import rotation_about, transform
from sidelong.types import FloatArray

LARGEST_ORDER = 72
"""Of an axis that is not continuous: teeth of a gear."""
SAME_TURN_RAD = float(np.deg2rad(1.0))
"""Turns closer than this are one operation: those about a 72-fold axis are 5 degrees apart."""


def _no_planes() -> FloatArray:
    return np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class Symmetry:
    """The symmetry of a part: a finite group of turns, turns about an axis by any angle, or all turns (a ball).

    Attributes
    ----------
    centre_m
        (3,) the point of the object frame that every operation leaves in its place.
    rotations
        (S, 3, 3) turns of the object frame about ``centre_m`` that map the part onto itself, identity first. With an
        ``axis`` one of each kind: identity, and a flip that turns the axis round where the part allows it.
    axis
        (3,) unit vector of a continuous symmetry; None where there is none.
    ball
        Whether every turn about the centre is one; ``rotations`` is then the identity and ``axis`` None.
    planes
        (P, 3) unit normals of mirror planes through ``centre_m``, as found or declared; of those that hold a continuous
        axis none is listed. No object turns into its mirror image, so planes do not join poses.
    """

    centre_m: FloatArray
    rotations: FloatArray
    axis: FloatArray | None = None
    ball: bool = False
    planes: FloatArray = field(default_factory=_no_planes)

    @property
    def trivial(self) -> bool:
        """Whether no pose has an equivalent but itself."""
        return len(self.rotations) == 1 and self.axis is None and not self.ball

    def equivalent(self, step_rad: float) -> FloatArray:
        """Return ``object_T_object`` (M, 4, 4) of the operations, identity first.

        Parameters
        ----------
        step_rad
            No operation is farther than half of this from one that is listed: a continuous axis gives 2 pi / step_rad
            of them, a ball 3,300 / step_rad^3. A finite group is listed as it is.

        Raises
        ------
        SettingsError
            The step is not between 0 and pi, both excluded.
        """
        if not 0 < step_rad < np.pi:
            raise SettingsError(f"symmetry: step_rad is {step_rad}, limits 0 to pi")
        from scipy.spatial.transform import Rotation  # not at import: the API process reads recipes without it

        turns = self.rotations
        if self.ball:
            turns = _all_turns(step_rad)
        elif self.axis is not None:
            angles_rad = _circle(step_rad)[:, None]
            about = Rotation.from_rotvec(angles_rad * self.axis).as_matrix()
            turns = (about[None, :] @ self.rotations[:, None]).reshape(-1, 3, 3)
        operations = np.tile(np.eye(4), (len(turns), 1, 1))
        operations[:, :3, :3] = turns
        operations[:, :3, 3] = self.centre_m - turns @ self.centre_m
        return operations

    def angle_rad(self, rotations_a: FloatArray, rotation_b: FloatArray) -> FloatArray:
        """Return the smallest turn (...) between orientations (..., 3, 3) and (..., 3, 3), modulo the symmetry.

        With a continuous axis it is the angle between the two axes. Exact to 1e-8 rad at pi, to rounding at 0.
        """
        if self.ball:
            return np.zeros(np.broadcast_shapes(rotations_a.shape[:-2], rotation_b.shape[:-2]))
        turned = rotations_a[..., None, :, :] @ self.rotations  # (..., S, 3, 3)
        if self.axis is None:
            return _turn_rad(turned, rotation_b[..., None, :, :]).min(axis=-1)
        axes_a, axis_b = turned @ self.axis, (rotation_b @ self.axis)[..., None, :]
        apart_rad = 2 * np.arctan2(np.linalg.norm(axes_a - axis_b, axis=-1), np.linalg.norm(axes_a + axis_b, axis=-1))
        return apart_rad.min(axis=-1)

    def nearest(self, a_T_object: FloatArray, to: FloatArray) -> FloatArray:
        """Return the pose (4, 4) equivalent to ``a_T_object`` whose orientation is nearest to that of ``to`` (4, 4)."""
        turns = self.rotations
        if self.ball:
            turns = (a_T_object[:3, :3].T @ to[:3, :3])[None]
        elif self.axis is not None:
            turns = np.stack([turn @ self._spin(a_T_object[:3, :3] @ turn, to[:3, :3]) for turn in turns])
        best = turns[int(np.argmin(_turn_rad(a_T_object[:3, :3] @ turns, to[:3, :3])))]
        return a_T_object @ transform(best, self.centre_m - best @ self.centre_m)

    def _spin(self, rotation_a: FloatArray, rotation_b: FloatArray) -> FloatArray:
        """Return the turn about the axis that brings a nearest to b: the twist of a swing and a twist."""
        from scipy.spatial.transform import Rotation

        assert self.axis is not None
        *vector, scalar = Rotation.from_matrix(rotation_a.T @ rotation_b).as_quat()
        return rotation_about(self.axis, 2 * float(np.arctan2(np.dot(vector, self.axis), scalar)))


def no_symmetry(centre_m: FloatArray) -> Symmetry:
    """Return the symmetry of a part that looks like itself in one orientation alone."""
    return Symmetry(np.asarray(centre_m, dtype=np.float64), np.eye(3)[None])


def _turn_rad(rotations_a: FloatArray, rotations_b: FloatArray) -> FloatArray:
    """Return the angle (...) between rotations (..., 3, 3)."""
    sine = np.linalg.norm(rotations_a - rotations_b, axis=(-2, -1)) / np.sqrt(8)
    cosine = np.sqrt(np.maximum(np.einsum("...ij,...ij", rotations_a, rotations_b) + 1, 0)) / 2
    return 2 * np.arctan2(sine, cosine)


def _circle(step_rad: float) -> FloatArray:
    """Return angles from 0 round the circle, evenly, no farther apart than the step."""
    return np.linspace(0.0, 2 * np.pi, int(np.ceil(2 * np.pi / step_rad)), endpoint=False)


def _all_turns(step_rad: float) -> FloatArray:
    """Return turns (M, 3, 3) such that none is farther than half a step from one of them, identity first."""
    from scipy.spatial.transform import Rotation

    # each of the three Euler angles is at most half a third of the step away
    around = _circle(step_rad / 3)
    tilts = np.linspace(0.0, np.pi, int(np.ceil(3 * np.pi / step_rad)) + 1)
    angles_rad = np.stack(np.meshgrid(tilts, around, around, indexing="ij"), axis=-1).reshape(-1, 3)
    return Rotation.from_euler("ZYZ", angles_rad[:, [1, 0, 2]]).as_matrix()


def group_from(generators: FloatArray) -> FloatArray | None:
    """Return the group (S, 3, 3) that turns (G, 3, 3) generate, identity first; None above 2 x ``LARGEST_ORDER``.

    Turns nearer to each other than ``SAME_TURN_RAD`` are taken for one, and the group is made exact afterwards.
    """
    members = [np.eye(3)]
    for member in _growing(members):
        for generator in generators:
            product = member @ generator
            if _turn_rad(np.stack(members), product).min() > SAME_TURN_RAD:
                members.append(product)
        if len(members) > 2 * LARGEST_ORDER:
            return None
    return _exact(np.stack(members))


def _growing(members: list[FloatArray]) -> Iterator[FloatArray]:
    index = 0
    while index < len(members):
        yield members[index]
        index += 1


def _exact(members: FloatArray) -> FloatArray:
    """Return the exact group next to one that closes only nearly: each turn is the mean of the ways to make it."""
    # (S, S): which member is the product g h
    table = np.stack([np.einsum("hij,kij->hk", one @ members, members).argmax(axis=1) for one in members])
    for _ in range(2):  # the error is squared each time
        quotients = members[table] @ np.swapaxes(members, -1, -2)
        left, _values, right = np.linalg.svd(quotients.mean(axis=1))
        members = left @ right
    return members
