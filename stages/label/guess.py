"""Labels of a surface from places on the body, colours and strokes, by a graph cut.

The scheme is that of GrabCut (C. Rother et al., 2004) on a mesh: colours are learned from the places that are
nearly certain, the surface is cut, colours are learned again from the cut.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from stages.label.config import LabelConfig
from stages.label.place import HAIR, SHOE, UPPER
from stages.shared.layers import GARMENT_LABELS, LABEL_IDS, NO_LABEL, SKIN
from stages.shared.meshes.labelling import alpha_expansion, edge_weights, tidy_labels
from stages.shared.meshes.regions import mesh_edges, vertex_areas

Doubles = NDArray[np.float64]
Labels = NDArray[np.uint8]

_BINS = (16, 32, 32)  # of L 0 to 100, a and b -64 to 64
_UNKNOWN_COLOR = 0.02  # share of a colour model that is spread over all colours
_CERTAIN = 0.75  # share of a label from which a place teaches its colour
_NEVER = 1e3  # cost of a label that cannot be there
_MOST_UNLIKELY = 6.0  # of a colour: largest difference in cost between two labels
_COLOR_EDGE = 8.0  # ΔE at which a border costs 1/e of what it costs on one colour
_LEAST_BORDER = 0.08
_SPREADS, _LEAST_SPREAD = 2.5, np.array([0.1, 0.1, 0.3])  # of logarithms of ratios and of brightness
_MOSTLY_SKIN = {HAIR: 0.6, SHOE: 0.4, UPPER: 0.4}  # share of a part that looks like skin: it is bare
_SHOD = 0.8  # share of a foot's skin that a shoe covers, where the foot is not bare
_LEAST_CONFIDENCE = 0.1


@dataclass(frozen=True, eq=False)
class Surface:
    """What is known of the template.

    Attributes:
        vertices, normals: (V, 3) m world. faces: (F, 3).
        colors: (V, 3) f32 sRGB 0..1. confidence: (V,) f32, 0 where no camera sees the vertex.
        shares: (V, L) of each label id by place.
        strokes: (V,) u8 label that someone drew there, `NO_LABEL` elsewhere.
    """

    vertices: Doubles
    normals: Doubles
    faces: NDArray[np.integer]
    colors: NDArray[np.float32]
    confidence: NDArray[np.float32]
    shares: Doubles
    strokes: Labels


@dataclass(frozen=True, eq=False)
class Guess:
    """Labels (V,) u8, and the parts that are bare: their usual labels are not there."""

    labels: Labels
    bare: tuple[int, ...]


def guess_labels(surface: Surface, config: LabelConfig) -> Guess:
    """The most likely labels of the template's vertices."""
    lab = _lab(surface.colors)
    seen = surface.confidence > _LEAST_CONFIDENCE
    areas = vertex_areas(surface.vertices, surface.faces)
    drawn = surface.strokes != NO_LABEL
    shares, bare = _without_bare_parts(surface, areas * seen)
    # Certain places teach the first colour models, and strokes always do.
    teachers = np.where(shares.max(axis=1) > _CERTAIN, shares.argmax(axis=1), NO_LABEL)
    teachers = np.where(drawn, surface.strokes, teachers)
    edges = mesh_edges(surface.vertices, surface.faces)
    weights = config.smoothness * edge_weights(surface.normals, edges) * _color_weights(lab, seen, edges)
    place_costs = -np.log(shares)
    labels = teachers
    for _ in range(config.rounds):
        costs = place_costs + _color_costs(lab, seen, areas, teachers, shares)
        costs[drawn] = _NEVER
        costs[drawn, surface.strokes[drawn]] = 0.0
        labels = alpha_expansion(costs - costs.min(axis=1, keepdims=True), edges, weights)
        teachers = labels
    labels = tidy_labels(
        surface.vertices,
        surface.faces,
        labels.astype(np.uint8),
        GARMENT_LABELS,
        config.smallest_island_m2,
        config.smallest_share,
    )
    return Guess(np.where(drawn, surface.strokes, labels).astype(np.uint8), bare)


def _without_bare_parts(surface: Surface, weights: Doubles) -> tuple[Doubles, tuple[int, ...]]:
    """The shares (V, L), with the labels of bare parts given to skin; and those labels.

    A part is bare when most of it has the colours of face and hands.
    """
    shares = surface.shares.copy()
    drawn = set(np.unique(surface.strokes).tolist())
    skin = (shares[:, SKIN] > _CERTAIN) & (weights > 0)
    alike = _like(surface.colors, skin)
    bare = []
    for label in _MOSTLY_SKIN:
        part = (shares.argmax(axis=1) == label) & (weights > 0)
        if label in drawn or not part.any():
            continue
        share = np.average(alike[part], weights=weights[part])
        if share > _MOSTLY_SKIN[label]:
            bare.append(label)
            shares[:, SKIN] += shares[:, label]
            shares[:, label] = 1e-6
        elif label == SHOE:  # feet that are not bare are in shoes, whichever colour those have
            shares[part, label] += _SHOD * shares[part, SKIN]
            shares[part, SKIN] *= 1.0 - _SHOD
    return shares, tuple(bare)


def _like(colors: NDArray[np.float32], sample: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(V,) whether colours (V, 3) sRGB have ratios as those of a sample; light changes ratios little."""
    if not sample.any():
        return np.zeros(len(colors), bool)
    logs = np.log(np.maximum(colors, 2 / 255))
    features = np.stack([logs[:, 0] - logs[:, 1], logs[:, 1] - logs[:, 2], logs.mean(axis=1)], axis=1)
    centre = np.median(features[sample], axis=0)
    spread = 1.4826 * np.median(np.abs(features[sample] - centre), axis=0)
    return np.asarray((np.abs(features - centre) < _SPREADS * np.maximum(spread, _LEAST_SPREAD)).all(axis=1))


@dataclass(frozen=True, eq=False)
class ColorModel:
    """A smoothed histogram of colours: `table` (16, 32, 32) of Lab, mean 1 over all colours."""

    table: Doubles

    @classmethod
    def learn(cls, lab: Doubles, weights: Doubles) -> ColorModel:
        """From colours (N, 3) Lab and their weights (N,); without colours, all are equally likely."""
        table = np.zeros(_BINS)
        if weights.sum() > 0:
            np.add.at(table, _bins(lab), weights / weights.sum())
        smooth = gaussian_filter(table, 1.0) * table.size
        rest = 1.0 if weights.sum() <= 0 else _UNKNOWN_COLOR
        return cls((1.0 - rest) * smooth + rest)

    def density(self, lab: Doubles) -> Doubles:
        """(N,) likelihood of colours (N, 3) against a uniform one."""
        return np.asarray(self.table[_bins(lab)], np.float64)


def _bins(lab: Doubles) -> tuple[NDArray[np.intp], ...]:
    low, high = np.array([0.0, -64.0, -64.0]), np.array([100.0, 64.0, 64.0])
    place = (lab - low) / (high - low) * np.array(_BINS)
    return tuple(np.clip(place.astype(np.intp), 0, np.array(_BINS) - 1).T)


def _color_costs(
    lab: Doubles, seen: NDArray[np.bool_], areas: Doubles, teachers: NDArray, shares: Doubles
) -> Doubles:
    """(V, L) −log likelihood of each vertex' colour under each label, at most `_MOST_UNLIKELY`.

    A label without a teacher cannot be there.
    """
    costs = np.zeros((len(lab), len(LABEL_IDS)))
    for label in LABEL_IDS:
        taught = seen & (teachers == label)
        if not taught.any():
            costs[:, label] = _NEVER
            continue
        model = ColorModel.learn(lab[taught], areas[taught])
        costs[seen, label] = -np.log(model.density(lab[seen]))
    least = costs.min(axis=1, keepdims=True)
    return np.where(costs < _NEVER, np.minimum(costs, least + _MOST_UNLIKELY), _NEVER)


def _color_weights(lab: Doubles, seen: NDArray[np.bool_], edges: NDArray) -> Doubles:
    """(E,) 1 within one colour, less where colours differ; 1 where a colour is not known."""
    first, second = edges[:, 0], edges[:, 1]
    difference = np.linalg.norm(lab[first] - lab[second], axis=1) / _COLOR_EDGE
    known = seen[first] & seen[second]
    return np.where(known, np.maximum(np.exp(-difference), _LEAST_BORDER), 1.0)


def _lab(colors: NDArray[np.float32]) -> Doubles:
    picture = np.ascontiguousarray(colors[None], np.float32)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2Lab)[0], np.float64)
