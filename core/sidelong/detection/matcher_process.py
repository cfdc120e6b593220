"""The matcher in a process of its own: it can die or hang without taking the scan along."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

from sidelong.detection.settings import DetectionSettings
from sidelong.detection.templates import TemplateSet
from sidelong.errors import DetectionError, MatcherDiedError
from sidelong.types import BoolArray, FloatArray, GrayImage, IntArray


@dataclass(frozen=True, eq=False)
class Matches:
    """Matches, best first: centres (M, 2) as (u, v), scores (M,), template rows (M,), and all found.

    A score counts standard deviations of the background, see :mod:`.matched_filter`.
    """

    centre_px: FloatArray
    score: FloatArray
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

    def match(self, image: GrayImage, region: BoolArray | None = None) -> Matches:
        """Search the image (H, W), already at the templates' focal length.

        Parameters
        ----------
        image
            8-bit grey.
        region
            (H, W) pixels where parts can be: edges elsewhere do not count, and no part is centred there.

        Raises
        ------
        MatcherDiedError
            The child died or missed the deadline; the next call starts another one.
        DetectionError
            The matcher refused the image.
        """
        answer = self._ask((image, region, self._settings.model_dump()))
        if isinstance(answer, str):
            raise DetectionError(f"matcher: refused the image of {image.shape[1]}x{image.shape[0]} px: {answer}")
        return Matches(*answer)

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
        descriptor = theirs.fileno()
        # in a session of its own: Ctrl-C is for us, and the child ends when our end of the pipe does
        self._child = subprocess.Popen(
            [sys.executable, "-m", "sidelong.detection.matcher_child", str(descriptor), str(self._templates.folder)],
            pass_fds=[descriptor], stdin=subprocess.DEVNULL, start_new_session=True,
            # it has threads of its own: those of the linear algebra wait for each other wherever a core is busy
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
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
