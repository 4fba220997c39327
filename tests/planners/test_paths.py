"""Least-cost simple paths against networkx."""

from __future__ import annotations

from itertools import islice

import networkx as nx
import numpy as np
import pytest

from nfv_torchrl.scenario import draw_random_substrate, paper_catalogue
from nfv_torchrl.search.paths import Pair, grow_paths, make_candidates, make_paths, paths_between
from nfv_torchrl.simulator.tables import build_tables


@pytest.mark.parametrize("count", [1, 3, 10])
def test_agrees_with_networkx(count):
    substrates = [draw_random_substrate(nodes, seed) for seed, nodes in enumerate((2, 5, 9, 14))]
    tables = build_tables(substrates, paper_catalogue())
    paths, candidates = make_paths(tables, count, rows=1), make_candidates(tables, count)
    grown = 0
    for net, substrate in enumerate(substrates):
        graph = substrate.to_networkx()
        for ingress in range(substrate.num_nodes):
            for egress in range(ingress + 1, substrate.num_nodes):
                pair = Pair(net, ingress, egress)
                expected = list(islice(nx.shortest_simple_paths(graph, ingress, egress, "unit_cost"), count))
                while (row := paths_between(tables, pair, paths, candidates)) == -1:
                    paths = grow_paths(paths)
                    grown += 1
                assert row == paths_between(tables, pair, paths, candidates)
                assert _nodes_of(paths, row, count, ingress) == expected
                _assert_links_join_nodes(substrate, paths, row, count, ingress)
    assert grown >= 3


def _hops(paths, row, count):
    for number in range(row * count, row * count + paths.found[row]):
        yield slice(paths.start[number], paths.start[number] + paths.hops[number])


def _nodes_of(paths, row, count, ingress):
    return [[ingress, *paths.node[hops].tolist()] for hops in _hops(paths, row, count)]


def _assert_links_join_nodes(substrate, paths, row, count, ingress):
    for hops in _hops(paths, row, count):
        nodes = np.concatenate([[ingress], paths.node[hops]])
        pairs = np.sort(np.stack([nodes[:-1], nodes[1:]], axis=1), axis=1)
        assert (substrate.links[paths.link[hops]] == pairs).all()
