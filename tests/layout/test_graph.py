"""Photosites as graphs."""

from __future__ import annotations

import numpy as np
import pytest

import foveasim as fs

LOG_POLAR = fs.layout.log_polar(n_sectors=24, r_min_um=3.0, r_max_um=30.0, n_rings=10)


def test_grid_has_edges_between_neighbours():
    graph = fs.layout.grid(n_x=4, n_y=3, pitch_um=2.0).to_graph()

    assert graph.edge_index.shape == (2, 2 * (3 * 3 + 4 * 2))
    np.testing.assert_allclose(graph.edge_length_um, 2.0)
    np.testing.assert_allclose(np.abs(graph.offset).sum(axis=1), 1.0)
    np.testing.assert_array_equal(np.sort(graph.edge_index[1]), graph.edge_index[1])


@pytest.mark.parametrize("n_neighbours", [None, 8])
def test_edges_agree_with_layout(n_neighbours):
    graph = LOG_POLAR.to_graph(n_neighbours=n_neighbours)
    begin, end = graph.edge_index
    shared = LOG_POLAR.adjacency()
    offset_um = graph.offset * graph.scale_um[end, np.newaxis]

    np.testing.assert_allclose(offset_um, LOG_POLAR.centroid_um[begin] - LOG_POLAR.centroid_um[end], atol=1e-12)
    np.testing.assert_allclose(graph.edge_length_um, shared.toarray()[begin, end])
    assert np.all(begin != end)
    if n_neighbours is None:
        assert begin.size == shared.nnz
    else:
        distance = np.linalg.norm(LOG_POLAR.centroid_um[:, np.newaxis] - LOG_POLAR.centroid_um, axis=-1)
        nearest = np.sort(distance, axis=1)[:, 1:9]
        found = np.sort(distance[end, begin].reshape(-1, 8), axis=1)
        np.testing.assert_allclose(found, nearest)


def test_radial_frames_turn_with_sites():
    """In log-polar layouts all rings and sectors have equal neighbourhoods, except those at the borders."""
    graph = LOG_POLAR.to_graph(frame="radial")
    end = graph.edge_index[1]
    ring = LOG_POLAR.columns["ring"]
    inner = {site: graph.offset[end == site] for site in np.flatnonzero((ring > 0) & (ring < 9))}
    expected = next(iter(inner.values()))
    expected = expected[np.lexsort(np.round(expected, 6).T)]

    for offset in inner.values():
        np.testing.assert_allclose(offset[np.lexsort(np.round(offset, 6).T)], expected, atol=1e-9)


def test_sites_at_equal_positions_have_other_neighbours():
    ring = fs.Layout.from_polygons(
        (np.array([[0, 0], [8, 0], [8, 8], [0, 8], [2, 2], [2, 6], [6, 6], [6, 2], [3, 3], [5, 3], [5, 5], [3, 5]], float),
         np.array([0, 4, 8, 12]), np.array([0, 2, 3]))
    )  # fmt: skip
    graph = ring.to_graph(n_neighbours=1)

    assert graph.edge_index.tolist() == [[1, 0], [0, 1]]
    assert ring.to_graph(n_neighbours=1, frame="radial", centre_um=(4.0, 4.0)).offset.tolist() == [
        [0.0, 0.0],
        [0.0, 0.0],
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_neighbours": 0}, "'n_neighbours' must be"),
        ({"n_neighbours": 240}, "at least 241 photosites, got 240"),
        ({"frame": "polar"}, "'frame' must be one of"),
    ],
)
def test_wrong_graphs_are_rejected(arguments, message):
    with pytest.raises(fs.FoveasimError, match=message):
        LOG_POLAR.to_graph(**arguments)
