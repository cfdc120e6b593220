"""Depth maps fused in a grid of voxels, which gives the surface of the whole bin as well."""
