"""Differentiable Gaussian splatting: one function, three backends, one contract (see `api.py`)."""
