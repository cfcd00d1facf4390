"""Gaussians and meshes in the formats of other programs."""
