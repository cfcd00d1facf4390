"""Workflows of several stages: demo, trade-off, learning curves, tables of the paper, playback, Snakefile."""
