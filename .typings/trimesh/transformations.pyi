# trimesh ships partial types: everything in it is Any, and becomes an annotated numpy array where it is called.
from typing import Any

def __getattr__(name: str) -> Any: ...
