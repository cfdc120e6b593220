"""What of an image is searched, and at which size: the settings' rectangle, a mask of the bin, the templates' scale."""

from __future__ import annotations

import numpy as np

from sidelong.detection.settings import DetectionSettings
from sidelong.errors import ImageError, SettingsError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.types import BoolArray, GrayImage


def search_region(camera: PinholeCamera, settings: DetectionSettings, mask: BoolArray | None) -> BoolArray | None:
    """Return the pixels (H, W) of the camera's image where parts can be; None for all of them.

    Parameters
    ----------
    camera
        Of the image.
    settings
        With ``region_px``.
    mask
        (H, W) True where parts can be, for example inside the bin.

    Raises
    ------
    SettingsError
        ``region_px`` lies outside the image.
    ImageError
        The mask is not of the image's size, or not boolean.
    """
    shape = (camera.height, camera.width)
    if mask is not None and (mask.shape != shape or mask.dtype != np.bool_):
        raise ImageError(f"detection: the mask is {mask.dtype} {mask.shape}, needs bool {shape}")
    if settings.region_px is None:
        return mask
    left, top, right, bottom = settings.region_px
    if right > camera.width or bottom > camera.height:
        raise SettingsError(
            f"detection.region_px: is {settings.region_px}, the image has {camera.width}x{camera.height} px"
        )
    region = np.zeros(shape, np.bool_)
    region[top:bottom, left:right] = True
    return region if mask is None else region & mask


def searched_image(image: GrayImage, camera: PinholeCamera, focal_px: float) -> GrayImage:
    """Return the image as a camera with square pixels and the templates' focal length sees it."""
    import cv2

    size = (max(1, round(camera.width * focal_px / camera.fx)), max(1, round(camera.height * focal_px / camera.fy)))
    how = cv2.INTER_AREA if focal_px < camera.fx else cv2.INTER_LINEAR
    return cv2.resize(image, size, interpolation=how).astype(np.uint8)


def resized(region: BoolArray, shape: tuple[int, int]) -> BoolArray:
    """Return the region at another size of the image, by the pixel that lies at the same place."""
    rows, columns = (
        np.minimum(((np.arange(new) + 0.5) * old / new).astype(np.intp), old - 1)
        for new, old in zip(shape, region.shape, strict=True)
    )
    return region[np.ix_(rows, columns)]
