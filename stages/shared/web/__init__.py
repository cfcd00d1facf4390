"""Gaussians in a browser: their bytes, the code that draws them, and where a viewer starts."""
