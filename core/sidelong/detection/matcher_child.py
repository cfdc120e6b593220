"""The child process that runs Line2D, which can crash (OpenCV 5.0). Started by :mod:`.matcher_process`.

Knows only OpenCV and numpy. Reads ``(image, threshold, max_matches)`` and answers ``(matches, total)`` or a message.
"""

from __future__ import annotations

import json
import sys
from multiprocessing.connection import Connection
from typing import Any

import cv2
import numpy as np


def main(descriptor: int, detector: Any, classes: list[str]) -> None:
    """Answer until the parent closes its end."""
    channel: Connection[Any, Any] = Connection(descriptor)
    channel.send("ready")
    index = {name: number for number, name in enumerate(classes)}
    while True:
        try:
            image, threshold, max_matches = channel.recv()
        except EOFError:
            return
        try:
            # in a one-channel image it finds nothing or nonsense, without a word
            found, _ = detector.match([cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)], threshold)
        except cv2.error as error:
            channel.send(str(error))
            continue
        kept = [(m.x, m.y, m.similarity, index[m.class_id], m.template_id) for m in found[:max_matches]]
        channel.send((np.array(kept, dtype=np.float64).reshape(-1, 5), len(found)))


def load(folder: str, options: dict[str, Any]) -> Any:
    """Return the detector with the classes of ``folder``."""
    contrib: Any = cv2  # its stubs leave linemod out
    linemod = contrib.linemod
    gradient = linemod.ColorGradient_create(options["weak"], options["features"], options["strong"])
    detector = linemod.Detector([gradient], options["pyramid"])
    detector.readClasses(options["classes"], f"{folder}/templates_%s.yml.gz")
    return detector


if __name__ == "__main__":
    OPTIONS = json.loads(sys.argv[3])
    main(int(sys.argv[1]), load(sys.argv[2], OPTIONS), OPTIONS["classes"])
