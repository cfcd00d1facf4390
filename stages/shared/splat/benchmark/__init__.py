"""Measures the splatting backends: `gw bench splat`."""
