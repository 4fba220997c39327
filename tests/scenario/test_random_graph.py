"""Random substrates: how many links, from which ranges, and which stream draws what."""

from __future__ import annotations

from collections import Counter

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.random_graph import draw_random_links, draw_random_substrate
from nfv_torchrl.scenario.streams import Stream, generator


@given(nodes=st.integers(2, 40), seed=st.integers(0, 2**32), degree=st.floats(0.01, 50))
def test_number_of_links_and_connectedness(nodes, seed, degree):
    links = draw_random_links(nodes, seed, degree)
    assert len(links) == min(max(round(degree * nodes / 2), nodes - 1), nodes * (nodes - 1) // 2)
    assert np.all(links[:, 0] < links[:, 1])
    assert _sorted_and_distinct(links)
    assert nx.is_connected(nx.Graph(links.tolist()))


def _sorted_and_distinct(links: np.ndarray) -> bool:
    rows = [tuple(row) for row in links.tolist()]
    return rows == sorted(set(rows))


def test_trees_are_uniform():
    """Of the 16 labelled trees on 4 nodes each comes up in about 1/16 of 3,200 draws (200 +- 4 standard deviations)."""
    counts = Counter(tuple(map(tuple, draw_random_links(4, seed, 0.1).tolist())) for seed in range(3200))
    assert len(counts) == 16
    assert all(abs(count - 200) < 4 * 14 for count in counts.values())


def test_paper_network_of_seed_0():
    """A golden draw: another one would change every published number."""
    substrate = draw_random_substrate(10, 0)
    assert substrate.num_links == 20
    assert substrate.vm_count.tolist() == [3, 6, 6, 3, 1, 4, 3, 4, 5, 2]
    assert substrate.total_vm_capacity == pytest.approx(24539.559246)
    assert substrate.max_vms == 6
    assert substrate.labels[:2] == ("0", "1")


def test_numbers_stay_in_their_ranges():
    substrate = draw_random_substrate(100, 3, vm_capacity=(1, 2), link_capacity=(3, 4), link_delay=(5, 6))
    exists = np.arange(6) < substrate.vm_count[:, None]
    for values, low, high in [
        (substrate.vm_capacity[exists], 1, 2),
        (substrate.vm_unit_cost[exists], 25, 75),
        (substrate.link_capacity, 3, 4),
        (substrate.link_delay, 5, 6),
        (substrate.link_unit_cost, 25, 75),
    ]:
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high
    assert set(substrate.vm_count.tolist()) == {1, 2, 3, 4, 5, 6}


def test_streams_do_not_disturb_each_other():
    base = draw_random_substrate(12, 5)
    denser = draw_random_substrate(12, 5, mean_degree=6)
    np.testing.assert_array_equal(base.vm_capacity, denser.vm_capacity)
    fewer_vms = draw_random_substrate(12, 5, vms=(1, 2))
    np.testing.assert_array_equal(base.links, fewer_vms.links)
    np.testing.assert_array_equal(base.link_delay, fewer_vms.link_delay)
    slower = draw_random_substrate(12, 5, link_capacity=(1, 2))
    np.testing.assert_array_equal(base.links, slower.links)
    np.testing.assert_array_equal(base.link_unit_cost, slower.link_unit_cost)


def test_seeds_differ():
    assert draw_random_substrate(10, 0).links.tolist() != draw_random_substrate(10, 1).links.tolist()


def test_a_key_splits_a_stream():
    first = [generator(0, Stream.WORKLOAD, *key).integers(2**60) for key in ((), (0,), (1,), (0, 0))]
    first += [generator(0, stream).integers(2**60) for stream in (Stream.FAILURES, Stream.CATALOGUE)]
    assert len(set(first)) == len(first)
    assert first[0] == generator(0, Stream.WORKLOAD).integers(2**60)


@pytest.mark.parametrize("seed", [-1, 1.5, "0", None, True])
def test_refuses_what_is_no_seed(seed):
    with pytest.raises(ScenarioError, match="integer >= 0"):
        generator(seed, Stream.WORKLOAD)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"nodes": 1}, "nodes: 1"),
        ({"nodes": 2.0}, "nodes: 2.0"),
        ({"mean_degree": 0}, "mean_degree: 0"),
        ({"mean_degree": float("nan")}, "mean_degree: nan"),
        ({"vms": (0, 3)}, "vms_min, vms_max"),
        ({"vms": (4, 3)}, "low above high"),
        ({"vms": (1.5, 3)}, "use integers"),
        ({"vm_capacity": (-5, 3)}, "vm_capacity: .* must be positive"),
        ({"vm_capacity": (0, 3)}, "vm_capacity: .* must be positive"),
        ({"vm_capacity": (5, 3)}, "vm_capacity: .* low above high"),
        ({"link_capacity": (1, float("inf"))}, "link_capacity: .* not finite"),
        ({"link_capacity": (1, 1e12)}, "link_capacity: .* exceeds"),
        ({"link_delay": (-1, 1)}, "link_delay: .* must be positive"),
        ({"link_unit_cost": (0, 1)}, "link_unit_cost: .* must be positive"),
    ],
)
def test_refuses(arguments, message):
    with pytest.raises(ScenarioError, match=message):
        draw_random_substrate(**{"nodes": 10, "seed": 0, **arguments})


def test_two_nodes_and_zero_delay_are_fine():
    substrate = draw_random_substrate(2, 0, link_delay=(0, 0))
    assert substrate.links.tolist() == [[0, 1]]
    assert substrate.link_delay.tolist() == [0.0]
