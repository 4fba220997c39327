"""Requests and networks drawn as Virne draws them: their means, and what is refused."""

from __future__ import annotations

from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from test_request_sets import CHAIN, world

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario import ServiceCatalogue, ServiceType, draw_chains, draw_waxman
from nfv_torchrl.scenario.formats.virne_laws import ChainLaws, read_laws
from nfv_torchrl.scenario.kinds import Resource
from nfv_torchrl.scenario.request_sets import holds_laws

FILES = Path(__file__).parent / "requests"
FILE = FILES / "virne_laws.yaml"
CATALOGUE = ServiceCatalogue((ServiceType(name="chain", **CHAIN),), {"f": {"cpu": 10}}, (Resource("cpu", False),))


def test_chains_follow_their_laws():
    laws = ChainLaws(requests=4000, arrival_rate=0.28)
    requests = draw_chains(3, CATALOGUE, laws)
    gaps = np.diff(requests.slot)
    assert requests.time is None and len(requests) == 4000 and requests.free_ends
    # Gaps are Poisson numbers: their variance is their mean. Five standard errors each.
    mean = 1 / 0.28
    assert abs(gaps.mean() - mean) < 5 * np.sqrt(mean / 4000)
    assert abs(gaps.var() - mean) < 5 * np.sqrt((mean + 2 * mean**2) / 4000)
    assert abs(requests.lifetime.mean() - 500) < 5 * 500 / np.sqrt(4000)
    own = requests.own
    length = own.chain_length
    assert abs(length.mean() - 6) < 5 * np.sqrt(80 / 12 / 4000) and {*length} == {*range(2, 11)}
    amounts = own.amount[np.arange(10) < length[:, None]]
    rates = own.rate[(np.arange(11) > 0) & (np.arange(11) < length[:, None])]
    for values, most in ((amounts, 20), (rates, 50)):
        assert {*values.ravel()} == {*range(most + 1)}
        assert abs(values.mean() - most / 2) < 5 * np.sqrt(((most + 1) ** 2 - 1) / 12 / values.size)
    assert not own.rate[:, 0].any() and not own.rate[np.arange(4000), length].any()
    again, other = draw_chains(3, CATALOGUE, laws), draw_chains(4, CATALOGUE, laws)
    assert np.array_equal(again.own.amount, own.amount) and not np.array_equal(other.slot, requests.slot)


def test_a_file_of_laws_is_drawn_from_with_the_scenario_seed():
    assert read_laws(FILE) == ChainLaws(requests=500)
    requests = world(FILE, seed=5).file_workload
    same = draw_chains(5, CATALOGUE, ChainLaws(requests=500))
    assert np.array_equal(requests.lifetime, same.lifetime) and np.array_equal(requests.own.rate, same.own.rate)
    assert [holds_laws(FILES / name) for name in ("virne_laws.yaml", "nfvdeep_laws.json")] == [True, True]
    assert [holds_laws(FILES / name) for name in ("virne_set", "nfvdeep_requests.json")] == [False, False]


def test_waxman_networks():
    networks = [draw_waxman(seed) for seed in range(20)]
    links = np.array([network.num_links for network in networks])
    # The three published networks have 492, 517 and 528.
    assert 450 < links.mean() < 580 and len({*links}) > 10
    for network in networks:
        assert nx.is_connected(nx.Graph(network.links.tolist())) and network.num_nodes == 100
        assert {*network.vm_unit_cost.ravel(), *network.link_unit_cost} == {1.0}
    capacities = np.concatenate([network.vm_capacity.ravel() for network in networks])
    assert {*capacities} == {*range(50, 101)} == {*np.concatenate([network.link_capacity for network in networks])}
    assert np.array_equal(draw_waxman(7).links, networks[7].links)
    with pytest.raises(ScenarioError, match="waxman: 1000 graphs of 40 nodes were in parts; raise beta or alpha"):
        draw_waxman(0, nodes=40, beta=0.01)
    with pytest.raises(ScenarioError, match="waxman: nodes 1, beta"):
        draw_waxman(0, nodes=1)
    generator = {"_target_": "nfv_torchrl.scenario.waxman.draw_waxman", "nodes": 20}
    assert world(FILE, seed=2, substrate={"generator": generator}).substrate.num_nodes == 20


REFUSED = [
    ("type: path", "type: random", "topology.type is 'random'; only chains are drawn"),
    ("name: bw", "name: ltc", "link_attrs_setting has .'ltc'.; only 'bw' is drawn"),
    ("dtype: int, low: 2", "dtype: float, low: 2", "v_net_size is .*; only uniform integers are drawn"),
    ("distribution: exponential", "distribution: normal", "lifetime is 'normal'; only exponential is drawn"),
    ("lam: 0.14", "lam: 0", "lam is 0; a positive number was expected"),
    ("low: 2", "low: 20", "functions: .20, 10.; use two integers in order"),
    ("num_v_nets: 500", "num_v_nets: 5000000", "requests: 5000000; use an integer from 1 to"),
    ("num_v_nets: 500", "[", "is not valid YAML"),
    ("name: cpu", "name: gpu", "says nothing of 'cpu', one of scenario.resources"),
]


@pytest.mark.parametrize(("old", "new", "message"), REFUSED)
def test_laws_that_are_not_drawn_are_refused_by_name(tmp_path, old, new, message):
    text = FILE.read_text()
    assert old in text
    (tmp_path / "laws.yaml").write_text(text.replace(old, new, 1))
    with pytest.raises(ScenarioError, match=f"laws.yaml: .*{message}"):
        world(tmp_path / "laws.yaml")
