"""What a detection reports beside the objects, and what it says where there are none."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class NothingFound(StrEnum):
    """Why a detection reports no object.

    ``EMPTY_SCENE``: nothing lies there; see :func:`sidelong.detection.emptiness.is_empty`. ``NO_MATCH``: something may
    lie there, but no template matches. ``NONE_VERIFIED``: templates match, but no pose explains what was seen.
    """

    EMPTY_SCENE = "empty_scene"
    NO_MATCH = "no_match"
    NONE_VERIFIED = "none_verified"


@dataclass(frozen=True)
class DetectionReport:
    """What a detection did.

    Attributes
    ----------
    matches, matches_kept
        Matches of templates that were found, and that were looked at.
    clusters
        Places where an object could be.
    match_s, align_s
        Seconds in the matcher, and of all the rest.
    nothing_found
        Why there is no object; None where there are.
    """

    matches: int
    matches_kept: int
    clusters: int
    match_s: float
    align_s: float
    nothing_found: NothingFound | None = None

    @property
    def capped(self) -> bool:
        """Whether there were more matches than ``max_matches``: the weakest were left out."""
        return self.matches > self.matches_kept
