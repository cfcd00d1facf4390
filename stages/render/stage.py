"""Render: a trained subject, or an outfit of bundles, in any motion, seen by any cameras.

One of two doors to `stages/shared/render_sequence/run.py`, which says what is read and written. Its video is
called film.mp4 (or .webm), and its result.json has the format gw-render.
"""

from __future__ import annotations

from functools import partial

from stages.shared.render_sequence import run as shared

run = partial(shared.run, shared.RENDER)
plan = partial(shared.plan, shared.RENDER)
