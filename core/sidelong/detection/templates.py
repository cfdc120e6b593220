"""proto"""

from __future__ import annotations
import numpy as np
from concurrent.futures import ThreadPoolExecutor
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import *


def view_directions(step_deg):
    rings = round(180 / step_deg)
    out = []
    for i in range(rings + 1):
        el = -np.pi / 2 + np.pi * i / rings
        n = max(1, round(2 * np.pi * np.cos(el) / np.radians(step_deg)))
        for j in range(n):
            az = 2 * np.pi * (j + 0.5 * (i % 2)) / n
            out.append((np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)))
    return np.array(out)


def distances(s):
    n = max(1, int(np.ceil(np.log(s.distance_m[1] / s.distance_m[0]) / np.log(s.distance_ratio) - 1e-9)))
    r = (s.distance_m[1] / s.distance_m[0]) ** (1 / n)
    return s.distance_m[0] * r ** (np.arange(n) + 0.5)
