"""Frames, cameras, meshes and rays."""
