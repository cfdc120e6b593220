"""Line2D in a process of its own: it can die or hang without taking the scan along."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from sidelong.detection.settings import DetectionSettings
from sidelong.detection.templates import PYRAMID, TemplateSet
from sidelong.errors import DetectionError, MatcherDiedError
from sidelong.types import FloatArray, GrayImage, IntArray

ALIGNMENT_PX = 32
"""Line2D with T = (4, 8) ends the process on other image sizes (OpenCV 5.0)."""


@dataclass(frozen=True, eq=False)
class Matches:
    """Matches, best first: corners (M, 2) as (u, v), similarity (M,) 0..100, template rows (M,), and all found."""

    corner_px: FloatArray
    similarity: FloatArray
    row: IntArray
    total: int


class MatcherProcess:
    """Starts the child when it is first needed, keeps it, and starts another one after it died.

    ``subprocess`` and not ``multiprocessing.Process``: a daemonic scan worker may not have children of that kind.
    """

    def __init__(self, templates: TemplateSet, settings: DetectionSettings) -> None:
        self._templates = templates
        self._settings = settings
        self._child: subprocess.Popen[bytes] | None = None
        self._channel: Connection[Any, Any] | None = None

    @property
    def pid(self) -> int | None:
        """Process id of the child, None where there is none."""
        return None if self._child is None else self._child.pid

    def match(self, image: GrayImage) -> Matches:
        """Search the image (H, W), already at the templates' focal length.

        Raises
        ------
        MatcherDiedError
            The child died or missed the deadline; the next call starts another one.
        DetectionError
            OpenCV refused the image.
        """
        rows, columns = image.shape
        padding = ((0, -rows % ALIGNMENT_PX), (0, -columns % ALIGNMENT_PX))
        padded = np.pad(image, padding, mode="edge")
        answer = self._ask((padded, self._settings.match_threshold, self._settings.max_matches))
        if isinstance(answer, str):
            raise DetectionError(f"matcher: OpenCV refused the image of {columns}x{rows} px: {answer}")
        found, total = answer
        names = found[:, 3:].astype(np.intp)
        return Matches(found[:, :2], found[:, 2], self._templates.rows(names[:, 0], names[:, 1]), int(total))

    def close(self) -> None:
        """End the child. Harmless when repeated."""
        if self._channel is not None:
            self._channel.close()
        if self._child is not None:
            self._child.kill()
            self._child.wait()
        self._channel, self._child = None, None

    def _ask(self, question: Any) -> Any:
        try:
            channel = self._channel or self._start()
            channel.send(question)
            return self._receive(channel)
        except (EOFError, OSError) as error:
            code = self._exit_code()
            self.close()
            raise MatcherDiedError(f"matcher: its process ended with code {code} while it searched an image") from error

    def _start(self) -> Connection[Any, Any]:
        ours, theirs = Pipe()
        options = {
            "weak": self._settings.weak_threshold,
            "strong": self._settings.strong_threshold,
            "features": self._templates.num_features,
            "pyramid": list(PYRAMID),
            "classes": list(self._templates.classes),
        }
        descriptor = theirs.fileno()
        # in a session of its own: Ctrl-C is for us, and the child ends when our end of the pipe does
        self._child = subprocess.Popen(
            [sys.executable, "-m", "sidelong.detection.matcher_child", str(descriptor),
             str(self._templates.folder), json.dumps(options)],
            pass_fds=[descriptor], stdin=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        theirs.close()
        self._channel = ours
        self._receive(ours)
        return ours

    def _receive(self, channel: Connection[Any, Any]) -> Any:
        if not channel.poll(self._settings.deadline_s):
            self.close()
            raise MatcherDiedError(f"matcher: no answer within the deadline of {self._settings.deadline_s:g} s")
        return channel.recv()

    def _exit_code(self) -> int | None:
        if self._child is None:
            return None
        try:
            return self._child.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            return None
