"""An exposure bracket of a static scene: what makes it usable, and which of its pixels to fit a response to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sidelong.errors import CalibrationError, ImageError
from sidelong.physics.response import LEVELS
from sidelong.types import BoolArray, FloatArray, GrayImage, IntArray

POOL_PIXELS = 20_000
"""Pixels the checks and the choice look at first; levels they miss are then searched for in the whole image."""
ORDER_STRIDE = 4
"""Of the pool, every so manyth pixel serves to compare the brightness of two images."""
SLOW_ROUND = 200
"""A round that adds less than one part in this of the pixels wanted is the last; the rest is drawn at random."""
RARE_HITS = 8
"""Pixels of a level, all images together, below which more of them are looked for in the whole images."""
FEWEST_EXPOSURES = 3
SMALLEST_SPAN = 2.0
"""Longest over shortest exposure: one stop, below it the steps in grey drown in rounding."""
SAME_EXPOSURE = 1e-6
FEWEST_USABLE = 20
"""Pixels of the pool off both clips that an image needs to take part, and a pair of images to be compared."""
TELLING_GREY = 24
"""Pixels darker than this in both images, or that near to saturation in both, do not tell which image is brighter."""
CLEAR_STEP = 1.2
"""Ratio of two exposures from which on the longer one must be visibly brighter."""


@dataclass(frozen=True, eq=False)
class Bracket:
    """Images of one static scene, by rising exposure.

    Attributes
    ----------
    images
        P images (H, W) of grey levels.
    exposures_s
        (P,) rising.
    names
        What messages call the images.
    """

    images: tuple[GrayImage, ...]
    exposures_s: FloatArray
    names: tuple[str, ...]

    def label(self, image: int) -> str:
        """Return the image as messages name it: name and exposure."""
        return f"{self.names[image]} ({1e3 * self.exposures_s[image]:.4g} ms)"

    def only(self, kept: BoolArray | IntArray) -> Bracket:
        """Return the bracket of the images kept."""
        index: list[int] = np.arange(len(self.names))[kept].tolist()
        return Bracket(
            tuple(self.images[i] for i in index), self.exposures_s[index], tuple(self.names[i] for i in index)
        )

    def grey(self, pixels: IntArray) -> GrayImage:
        """Return the levels (P, m) of pixels given by flat indices (m,)."""
        return np.stack([image.reshape(-1)[pixels] for image in self.images])


@dataclass(frozen=True, eq=False)
class Samples:
    """Pixels chosen from a bracket: ``grey`` (n, P) levels, ``pixels`` (n,) flat indices into an image."""

    grey: NDArray[np.intp]
    pixels: IntArray


def read_bracket(
    images: Sequence[GrayImage] | GrayImage,
    exposures_s: Sequence[float] | FloatArray,
    names: Sequence[str] | None = None,
) -> Bracket:
    """Check images and exposure times one by one and sort them by exposure.

    Parameters
    ----------
    images
        P images (H, W) uint8, all of one size, in any order.
    exposures_s
        (P,) exposure times in seconds; a time may occur twice.
    names
        (P,) names for messages; ``image 0`` and so on where None.

    Raises
    ------
    ImageError
        An image is not 8-bit grey or differs in size from the first.
    CalibrationError
        Numbers of images and times differ, or a time is not positive and finite.
    """
    labels = tuple(names) if names is not None else tuple(f"image {i}" for i in range(len(images)))
    times = np.asarray(exposures_s, dtype=np.float64).reshape(-1)
    if not len(images) == len(times) == len(labels):
        raise CalibrationError(f"bracket: {len(images)} images, {len(times)} exposures, {len(labels)} names: one each")
    if not labels:
        raise CalibrationError("bracket: no images")
    for image, time_s, label in zip(images, times, labels, strict=True):
        _check_image(image, images[0], label, labels[0])
        if not (np.isfinite(time_s) and time_s > 0):
            raise CalibrationError(f"{label}: the exposure is {time_s} s, needs a positive finite number of seconds")
    order: list[int] = np.argsort(times, kind="stable").tolist()
    return Bracket(tuple(images[i] for i in order), times[order], tuple(labels[i] for i in order))


def draw_pool(bracket: Bracket, seed: int) -> IntArray:
    """Return flat indices of ``POOL_PIXELS`` pixels, one at random from each equal stretch; of all where fewer."""
    size = bracket.images[0].size
    if size <= POOL_PIXELS:
        return np.arange(size)
    edges = np.linspace(0, size, POOL_PIXELS + 1).astype(np.intp)
    return edges[:-1] + (np.random.default_rng(seed).random(POOL_PIXELS) * np.diff(edges)).astype(np.intp)


def usable_images(bracket: Bracket, grey: GrayImage) -> BoolArray:
    """Say which images (P,) have enough pixels off both clips.

    Parameters
    ----------
    bracket
        The images.
    grey
        (P, m) levels of the pool.

    Raises
    ------
    CalibrationError
        All images are saturated, all are dark, or those that are neither have too few exposures or too close ones.
    """
    _check_spread(bracket.exposures_s)
    usable = ((grey > 0) & (grey < LEVELS - 1)).sum(axis=1) >= FEWEST_USABLE
    if usable.sum() == 0:
        first, last = grey[0], grey[-1]
        if (last == 0).mean() > 0.5:
            raise CalibrationError(
                f"bracket: all images are dark; of {bracket.label(-1)}, the longest, {(last == 0).mean():.1%} of the "
                f"pixels are 0 and fewer than {FEWEST_USABLE} of {grey.shape[1]} usable: expose longer or add light"
            )
        raise CalibrationError(
            f"bracket: all images are saturated; of {bracket.label(0)}, the shortest, {(first == 255).mean():.1%} of "
            f"the pixels are 255 and fewer than {FEWEST_USABLE} of {grey.shape[1]} usable: expose shorter or dim the "
            "light"
        )
    if not usable.all():
        _check_spread(bracket.exposures_s[usable], f" among the {int(usable.sum())} images that are not clipped")
    return usable


def check_brightness_order(bracket: Bracket, grey: GrayImage) -> None:
    """Refuse a bracket where a clearly longer exposure is not brighter: swapped times, or one image used twice.

    Raises
    ------
    CalibrationError
        Names the two images and their mean difference.
    """
    signed = grey[:, ::ORDER_STRIDE].astype(np.int16)
    for short, long in _telling_pairs(bracket.exposures_s):
        a, b = signed[short], signed[long]
        telling = (np.maximum(a, b) > TELLING_GREY) & (np.minimum(a, b) < LEVELS - 1 - TELLING_GREY)
        if telling.sum() < FEWEST_USABLE:
            continue
        step = (b - a)[telling]
        doubt = 3 * step.std() / np.sqrt(step.size)
        ratio = bracket.exposures_s[long] / bracket.exposures_s[short]
        if step.mean() < -doubt or (ratio > CLEAR_STEP * (1 - SAME_EXPOSURE) and step.mean() <= doubt):
            raise CalibrationError(
                f"{bracket.label(long)}: exposed {ratio:.3g} times as long as {bracket.label(short)}, but its pixels "
                f"are {step.mean():+.2f} grey levels brighter on average, needs more than {doubt:.2f}: were exposure "
                "times swapped, or one image taken twice?"
            )


def _telling_pairs(exposures_s: FloatArray) -> list[tuple[int, int]]:
    """Pair each image with the next longer one and with the first that is clearly longer."""
    pairs: list[tuple[int, int]] = []
    for short, time_s in enumerate(exposures_s):
        firsts = np.searchsorted(exposures_s, [time_s * (1 + SAME_EXPOSURE), time_s * CLEAR_STEP])
        pairs += [(short, int(long)) for long in np.unique(firsts) if long < len(exposures_s)]
    return pairs


def choose_samples(bracket: Bracket, pool: IntArray, count: int, seed: int) -> Samples:
    """Choose pixels so that every grey level of every image that has it is hit, and all are hit evenly.

    In rounds over the images, each level that was hit less than once (then twice, and so on) gets a pixel at random.
    Pixels off the clips in fewer than two images say nothing of the response and are passed over.

    Parameters
    ----------
    bracket
        The images.
    pool
        Flat indices of candidates; pixels with levels they miss are added from the whole image.
    count
        How many to choose at most.
    seed
        Of the random choice.

    Returns
    -------
    Samples
        At most ``count``; fewer, possibly none, where the bracket offers fewer.
    """
    pool = np.concatenate([pool, _rare_pixels(bracket, pool)])
    grey = bracket.grey(pool)
    linked = ((grey > 0) & (grey < LEVELS - 1)).sum(axis=0, dtype=np.uint8) >= 2
    chosen = np.flatnonzero(linked)
    if len(chosen) > count:
        chosen = _even_choice(grey, linked, count, np.random.default_rng(seed))
    return Samples(grey[:, chosen].T.astype(np.intp), pool[chosen])


def _even_choice(grey: GrayImage, free: BoolArray, count: int, random: np.random.Generator) -> IntArray:
    """Return ``count`` of the ``free`` columns of ``grey`` (P, m), chosen in rounds; see :func:`choose_samples`."""
    free = free.copy()
    orders = [np.argsort(row, kind="stable") for row in grey]
    ends = [np.r_[0, np.cumsum(np.bincount(row, minlength=LEVELS))] for row in grey]
    hits = np.zeros((len(grey), LEVELS), dtype=np.intp)
    chosen: list[IntArray] = []
    total = wanted = 0
    while total < count:
        before, wanted = total, wanted + 1
        for order, end, hit in zip(orders, ends, hits, strict=True):
            levels = np.flatnonzero((hit < wanted) & (np.diff(end) > 0))
            levels = levels[(levels > 0) & (levels < LEVELS - 1)]
            place = end[levels] + (random.random(len(levels)) * (end[levels + 1] - end[levels])).astype(np.intp)
            picked = order[place]  # distinct: one per level of the same image
            picked = picked[free[picked]]
            free[picked] = False
            chosen.append(picked)
            total += len(picked)
            for other, row in zip(hits, grey, strict=True):
                other += np.bincount(row[picked], minlength=LEVELS)
        if total < count and total - before <= count // SLOW_ROUND:  # the levels still wanted have no pixels left
            chosen.append(random.permutation(np.flatnonzero(free))[: count - total])
            break
    return np.concatenate(chosen)[:count]


def _rare_pixels(bracket: Bracket, pool: IntArray) -> IntArray:
    """Return pixels with levels of which the pool has few: one for each image that has the level, and the pool not."""
    if len(pool) == bracket.images[0].size:
        return np.empty(0, dtype=np.intp)
    hits = np.stack([np.bincount(row, minlength=LEVELS) for row in bracket.grey(pool)])
    rare = hits.sum(axis=0) < RARE_HITS
    rare[[0, LEVELS - 1]] = False  # clipped
    found: set[int] = set()
    for image, hit in zip(bracket.images if rare.any() else (), hits, strict=False):
        content = image.tobytes()  # for a rare level, searching bytes is many times faster than indexing the image
        middle = len(content) // 2  # where the scene is; the border is often empty
        levels: list[int] = np.flatnonzero(rare & (hit == 0)).tolist()
        for level in levels:
            place = content.find(level, middle)
            found.add(place if place >= 0 else content.find(level, 0, middle))
    found.discard(-1)
    return np.array(sorted(found), dtype=np.intp)


def _check_image(image: GrayImage, first: GrayImage, label: str, first_label: str) -> None:
    if image.ndim != 2:
        raise ImageError(f"{label}: has shape {image.shape}, needs (H, W): one grey channel")
    if image.dtype != np.uint8:
        raise ImageError(f"{label}: has {image.dtype} pixels, needs uint8: the response is a table of {LEVELS} levels")
    if image.shape != first.shape or image.size == 0:
        raise ImageError(f"{label}: has shape {image.shape}, needs that of {first_label}, {first.shape}, and pixels")


def _check_spread(exposures_s: FloatArray, among: str = "") -> None:
    """Refuse rising exposures that are too few or too close."""
    distinct = 1 + int((np.diff(exposures_s) > SAME_EXPOSURE * exposures_s[:-1]).sum()) if exposures_s.size else 0
    if distinct < FEWEST_EXPOSURES:
        raise CalibrationError(
            f"bracket: {distinct} distinct exposures{among}, needs {FEWEST_EXPOSURES}: add exposures between those "
            "that clip dark and bright"
        )
    span = exposures_s[-1] / exposures_s[0]
    if span < SMALLEST_SPAN:
        raise CalibrationError(
            f"bracket: the longest exposure{among} is {span:.3g} times the shortest, needs {SMALLEST_SPAN:g}: grey "
            "levels are not linked; take exposures further apart"
        )
