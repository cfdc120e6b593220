"""Everything sidelong raises on purpose.

::

    SidelongError
    ├── InputError               what the caller gave cannot be used
    │   ├── SettingsError        a setting is out of its range
    │   ├── UnknownNameError     no such data set, part, driver, scene or view
    │   ├── DatasetError         a recorded data set breaks its layout
    │   ├── ImageError           an image is missing, truncated or of the wrong size
    │   ├── DepthError           a depth map carries no measurement
    │   ├── PoseError            a transform is not a rigid motion
    │   ├── MeshError            a CAD model is empty, open or in the wrong unit
    │   └── CalibrationError     captures cannot carry a calibration, or a calibration does not fit the device
    ├── DetectionError           the matcher could not answer
    │   └── MatcherDiedError     its child process died or missed its deadline
    └── DeviceError              a camera or an arm failed; ``device`` names it
        ├── DeviceUnavailableError   it cannot be opened
        ├── DeviceTimeoutError       it missed its deadline
        ├── DeviceLostError          it stopped answering
        ├── MotionRefusedError       a target is outside the limits; nothing moved
        └── MotionStoppedError       a stop was asked for while it moved

Every message names the device, file or field, the value, its unit and the limit. The expected endings of a scan
are values of :class:`sidelong.types.Stop`, not exceptions.
"""

from __future__ import annotations


class SidelongError(Exception):
    """Base of all errors raised on purpose."""


class InputError(SidelongError):
    """What the caller gave cannot be used."""


class SettingsError(InputError):
    """A setting is out of its range."""


class UnknownNameError(InputError):
    """No data set, part, driver, scene or view has this name."""


class DatasetError(InputError):
    """A recorded data set breaks the layout it should have."""


class ImageError(InputError):
    """An image is missing, truncated or of the wrong size."""


class DepthError(InputError):
    """A depth map carries no measurement."""


class PoseError(InputError):
    """A transform is not a rigid motion."""


class MeshError(InputError):
    """A CAD model is empty, open or in the wrong unit."""


class CalibrationError(InputError):
    """Captures cannot carry the calibration that is asked of them, or a calibration does not fit the device."""


class DetectionError(SidelongError):
    """The template matcher could not answer."""


class MatcherDiedError(DetectionError):
    """The child process of the matcher died or missed its deadline."""


class DeviceError(SidelongError):
    """A camera or an arm failed.

    Parameters
    ----------
    device
        Name of the device, the first word of the message.
    problem
        What happened, with value, unit and limit.
    """

    def __init__(self, device: str, problem: str) -> None:
        super().__init__(f"{device}: {problem}")
        self.device = device
        self.problem = problem

    def __reduce__(self) -> tuple[type[DeviceError], tuple[str, str]]:
        # the message has one argument and the constructor two: say how to cross a process boundary
        return type(self), (self.device, self.problem)


class DeviceUnavailableError(DeviceError):
    """The device cannot be opened."""


class DeviceTimeoutError(DeviceError):
    """The device missed its deadline."""


class DeviceLostError(DeviceError):
    """The device stopped answering."""


class MotionRefusedError(DeviceError):
    """A target is outside the limits; nothing moved."""


class MotionStoppedError(DeviceError):
    """A stop was asked for while the arm moved."""
