"""Scenarios: offered load, endpoint pairs, independence of streams, refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
import toy

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.scenario import Scenario, draw_endpoint_pairs, paper_scenario


def test_offered_load_by_hand():
    """Toy: duo needs 10 + 20, solo 20 Mcycles/s, 25 in the mean; 330 installed; one a slot for 2 s over 6 slots."""
    expected = 1.0 * 2.0 * (1 - math.exp(-3)) * 25.0 / 330.0
    assert toy.toy_scenario().offered_load() == pytest.approx(expected)


def test_offered_load_of_the_papers_settings():
    assert paper_scenario().offered_load() == pytest.approx(0.85, abs=0.005)
    mean = np.mean([paper_scenario(seed=seed).offered_load() for seed in range(30)])
    assert mean == pytest.approx(0.85, abs=0.05)
    heavy = [paper_scenario(seed=seed, arrival_rate=25, mean_lifetime=1200).offered_load() for seed in range(30)]
    assert np.mean(heavy) == pytest.approx(2.97, abs=0.2)


def test_offered_load_of_a_workload_file(tmp_path):
    """Two duos (30) and a solo (20) of 1, 2 and 3 s in 6 slots: half a request a slot for 2 s of 80 / 3 Mcycles/s."""
    requests = toy.workload_of((0, 0, 0, 3, 1.0), (1, 0, 0, 3, 2.0), (2, 1, 3, 0, 3.0))
    requests.to_csv(tmp_path / "w.csv", toy.toy_catalogue())
    scenario = toy.toy_scenario(workload_path=str(tmp_path / "w.csv"))
    assert scenario.offered_load() == pytest.approx(0.5 * 2 * (1 - math.exp(-3)) * (80 / 3) / 330)


def test_target_rho_scales_all_vms_by_one_factor():
    plain, scaled = paper_scenario(), paper_scenario(substrate={"target_rho": 1.3})
    assert scaled.offered_load() == pytest.approx(1.3, rel=1e-6)
    exists = plain.substrate.vm_capacity > 0
    factor = scaled.substrate.vm_capacity[exists] / plain.substrate.vm_capacity[exists]
    np.testing.assert_allclose(factor, plain.offered_load() / 1.3, rtol=1e-6)
    np.testing.assert_array_equal(scaled.substrate.link_capacity, plain.substrate.link_capacity)
    np.testing.assert_array_equal(scaled.endpoint_pairs, plain.endpoint_pairs)


def test_a_scaled_substrate_comes_back_from_its_file_as_it_was(tmp_path):
    scaled = paper_scenario(substrate={"target_rho": 1.3})
    scaled.substrate.to_json(tmp_path / "s.json")
    again = paper_scenario(substrate={"target_rho": 1.3, "path": str(tmp_path / "s.json")})
    np.testing.assert_array_equal(again.substrate.vm_capacity, scaled.substrate.vm_capacity)


# ---------------------------------------------------------------- endpoint pairs


def test_pairs_are_distinct_and_different():
    pairs = paper_scenario(nodes=4, pairs_per_service=12).endpoint_pairs
    assert pairs.shape == (3, 12, 2)
    everything = {(u, v) for u in range(4) for v in range(4) if u != v}
    for of_service in pairs.tolist():
        assert set(map(tuple, of_service)) == everything


def test_golden_pairs_of_seed_0():
    assert paper_scenario().endpoint_pairs[:, :2].tolist() == [[[1, 2], [4, 9]], [[9, 8], [6, 3]], [[0, 6], [5, 3]]]


def test_more_pairs_keep_the_first_ones():
    substrate = paper_scenario().substrate
    few, many = (draw_endpoint_pairs(3, count, substrate, 0) for count in (4, 20))
    np.testing.assert_array_equal(few, many[:, :4])
    np.testing.assert_array_equal(few[:2], draw_endpoint_pairs(2, 4, substrate, 0))


def test_too_few_pairs():
    with pytest.raises(ScenarioError, match=r"pairs_per_service: 10; a network of 3 nodes has 6 distinct .* 1 .. 6"):
        paper_scenario(nodes=3)
    assert paper_scenario(nodes=3, pairs_per_service=6).endpoint_pairs.shape == (3, 6, 2)
    assert paper_scenario(nodes=3, endpoints="uniform").endpoint_pairs is None


def test_streams_leave_each_other_alone():
    base = paper_scenario()
    for changes in ({"pairs_per_service": 3}, {"mean_lifetime": 240}, {"arrival_rate": 2.5}, {"endpoints": "uniform"}):
        other = paper_scenario(**changes)
        for name in ("links", "link_delay", "vm_capacity", "vm_unit_cost"):
            np.testing.assert_array_equal(getattr(base.substrate, name), getattr(other.substrate, name))
    denser = paper_scenario(substrate={"mean_degree": 6, "vms_max": 2})
    np.testing.assert_array_equal(base.endpoint_pairs, denser.endpoint_pairs)
    np.testing.assert_array_equal(base.workload(0).lifetime, denser.workload(0).lifetime)
    np.testing.assert_array_equal(base.workload(0).ingress, denser.workload(0).ingress)


def test_the_scenario_seed_draws_another_network_and_the_same_arrivals():
    one, other = paper_scenario(seed=0), paper_scenario(seed=1)
    assert one.substrate.links.tolist() != other.substrate.links.tolist()
    assert one.endpoint_pairs.tolist() != other.endpoint_pairs.tolist()
    np.testing.assert_array_equal(one.workload(0).slot, other.workload(0).slot)


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": -1}, "integer >= 0"),
        ({"horizon": 0}, "horizon: 0"),
        ({"max_steps": 0}, "max_steps: 0"),
        ({"warmup": -1}, "warmup: -1"),
        ({"warmup": 6}, "warmup: 6 slots; .* below the horizon of 6"),
        ({"arrival_rate": 0}, "arrival_rate: 0"),
        ({"arrival_rate": 1.3}, "arrival_rate: 1.3; .* multiple of 0.5"),
        ({"arrival_rate": math.nan}, "arrival_rate: nan"),
        ({"arrival_rate": math.inf}, "arrival_rate: inf"),
        ({"mean_lifetime": 0}, "mean_lifetime: 0 s"),
        ({"mean_lifetime": math.inf}, "mean_lifetime: inf s"),
        ({"endpoints": "random"}, r"endpoints: 'random' is unknown; use one of \['catalogue', 'uniform'\]"),
        ({"mask": "all"}, r"mask: 'all' is unknown; use one of \['adjacency', 'feasible'\]"),
        ({"endpoint_pairs": None}, "endpoint_pairs: needed"),
        ({"endpoints": "uniform"}, "endpoint_pairs: .* must be None with endpoints=uniform"),
        ({"endpoint_pairs": np.zeros((1, 2, 2), int)}, r"shape \[1, 2, 2\]; \[2, P, 2\] was expected"),
        ({"endpoint_pairs": np.array([[[0, 4]], [[1, 2]]])}, "must lie in 0 .. 3"),
        ({"endpoint_pairs": np.array([[[0, 0]], [[1, 2]]])}, "they must differ"),
        ({"endpoint_pairs": np.array([[[0.5, 1]], [[1, 2]]])}, "endpoint_pairs: are float64; nodes are integers"),
        ({"seed": 10**400}, "seed: .* is not a seed"),
        ({"horizon": "6"}, "horizon: '6' where an integer"),
        ({"horizon": 2.5}, "horizon: 2.5 where an integer"),
        ({"horizon": 10**400}, "horizon: 10+[.]{3} where an integer"),
        ({"max_steps": True}, "max_steps: True where an integer"),
        ({"arrival_rate": None}, "arrival_rate: None where a number"),
        ({"arrival_rate": 10**400}, "arrival_rate: 10+[.]{3}; .* multiple of 0.5"),
        ({"arrival_rate": 0.25}, "arrival_rate: 0.25; .* multiple of 0.5"),
        ({"mean_lifetime": 1e-300}, "mean_lifetime: 1e-300 s; use a positive number, from 1e-06"),
        ({"mean_lifetime": 1e300}, "mean_lifetime: 1e[+]300 s; .* to 1e[+]12"),
        ({"colocation": "no"}, "colocation: 'no' where true or false"),
        ({"mask": False}, "mask: False where text"),
        ({"name": None}, "name: None where text"),
        ({"workload_path": 3}, "workload_path: 3 where text"),
        ({"substrate": "abilene"}, "substrate: 'abilene' where a Substrate"),
        ({"failures": {"p_repair": 1}}, "failures: .* where a FailureModel"),
    ],
)
def test_refuses(changes, message):
    with pytest.raises(ScenarioError, match=message):
        toy.toy_scenario(**changes)


def test_numbers_of_numpy_become_pythons_own():
    scenario = toy.toy_scenario(horizon=np.int64(6), max_steps=np.int32(9))
    assert (type(scenario.horizon), type(scenario.max_steps)) == (int, int)


def test_reading_a_file_that_was_not_given():
    with pytest.raises(ScenarioError, match=r"workload.path: is null"):
        _ = toy.toy_scenario().file_workload


def test_one_slot_is_a_horizon():
    assert toy.toy_scenario(horizon=1).workload(0).slot.tolist() in ([], [0], [0, 0])


def test_replace_checks_again():
    scenario: Scenario = toy.toy_scenario()
    assert scenario.replace(colocation=True).colocation
    with pytest.raises(ScenarioError, match="horizon"):
        scenario.replace(horizon=-1)
