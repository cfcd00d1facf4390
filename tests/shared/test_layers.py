"""The table of layers: what is derived from it, and the ids and colours that captures on disk rely on."""

from __future__ import annotations

import pytest

from stages.shared import layers


def test_order_of_dressing_and_slots() -> None:
    assert layers.LAYERS == ("body", "lower", "upper", "outer")
    assert layers.LAYERS[1:] == layers.SLOTS
    assert layers.in_order({"outer", "body", "unknown", "lower"}) == ["body", "lower", "outer"]
    assert layers.garments_of(["outer", "upper", "body", "lower"]) == ["lower", "upper", "outer"]


def test_ids_are_those_of_the_label_images() -> None:
    assert layers.label_legend() == "0 skin, 1 hair, 2 shoe, 3 upper, 4 lower, 5 outer, 255 none"
    assert set(layers.LABEL_COLORS) == set(layers.LABELS)
    assert len(set(layers.LABEL_COLORS.values())) == len(layers.LABELS)
    assert list(range(6)) == list(layers.LABEL_IDS)  # votes for labels are stored in columns of these numbers


def test_every_label_belongs_to_one_layer_and_one_region() -> None:
    assert set(layers.BODY_LABELS) == {0, 1, 2}
    assert layers.GARMENT_LABELS == (4, 3, 5)
    assert layers.OUTERMOST_FIRST == (5, 3, 4, 1, 2, 0)
    assert sorted(label for region in layers.REGIONS.values() for label in region) == list(layers.LABEL_IDS)
    assert [layers.label_of(layer) for layer in layers.LAYERS] == [0, 4, 3, 5]
    with pytest.raises(KeyError):
        layers.label_of("whole")


def test_layers_that_touch_are_named_inner_first() -> None:
    order = (*layers.LAYERS, *layers.BASELINE_LAYERS)
    assert all(order.index(inner) < order.index(outer) for inner, outer in layers.TOUCHING)
    assert {outer for _, outer in layers.TOUCHING} >= set(layers.SLOTS)
