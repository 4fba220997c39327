"""Services: the paper's numbers and what a catalogue refuses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.services import ServiceCatalogue, ServiceType, paper_catalogue


def test_paper_catalogue_by_hand():
    """Video: 4 Mbit/s times NAT 0.092, FW 0.09, TM 1.33, VOC 0.54, IDPS 1.07 cycles/bit."""
    catalogue = paper_catalogue()
    assert catalogue.names == ("web", "voip", "video")
    assert catalogue.chain_length.tolist() == [4, 5, 5]
    assert catalogue.rate.tolist() == [0.1, 0.064, 4.0]
    assert catalogue.tolerable_delay.tolist() == [500.0, 100.0, 100.0]
    np.testing.assert_allclose(catalogue.load[0], [0.0092, 0.009, 0.133, 0.107, 0.0])
    np.testing.assert_allclose(catalogue.load[2], [0.368, 0.36, 5.32, 2.16, 4.28])
    np.testing.assert_allclose(catalogue.mix, 1 / 3)
    assert catalogue.mean_load == pytest.approx((0.2582 + 0.064 * 1.694 + 12.488) / 3)


def test_weights_make_the_mix():
    types = [ServiceType(name, ("A",), 1.0, 10.0, weight) for name, weight in (("a", 3), ("b", 0), ("c", 1))]
    catalogue = ServiceCatalogue(types=tuple(types), vnfs={"A": 2.0})
    assert catalogue.mix.tolist() == [0.75, 0.0, 0.25]
    assert catalogue.load.tolist() == [[2.0], [2.0], [2.0]]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": ""}, "empty name"),
        ({"chain": (), "ingress": "any"}, "services.a: has no chain, so its ends cannot be free"),
        ({"egress": "all"}, "services.a.egress: 'all'; use any"),
        ({"rates": (1.0,)}, "services.a.rates: there are 1; a chain of"),
        ({"rate": 0}, "services.a.rate"),
        ({"rate": -1}, "services.a.rate"),
        ({"rate": math.nan}, "services.a.rate"),
        ({"tolerable_delay": 0}, "services.a.tolerable_delay"),
        ({"tolerable_delay": math.inf}, "services.a.tolerable_delay"),
        ({"weight": -0.5}, "services.a.weight"),
        ({"weight": math.nan}, "services.a.weight"),
    ],
)
def test_refuses_a_type(changes, message):
    with pytest.raises(ScenarioError, match=message):
        ServiceType(**{"name": "a", "chain": ("A",), "rate": 1.0, "tolerable_delay": 1.0, **changes})


@pytest.mark.parametrize(
    ("types", "vnfs", "message"),
    [
        ([], {"A": 1.0}, "there are none"),
        ([("a", "A", 1)] * 2, {"A": 1.0}, "names must differ"),
        ([("a", "A", 0), ("b", "A", 0)], {"A": 1.0}, "all weights are 0"),
        ([("a", "B", 1)], {"A": 1.0}, r"services.a.chain: unknown VNF 'B'; .* \['A'\]"),
        ([("a", "A", 1)], {"A": 0.0}, "vnfs.A: 0.0 cycles/bit"),
        ([("a", "A", 1)], {"A": math.nan}, "vnfs.A: nan"),
        ([("a", "A", 1)], {"A": 1e-9}, "VNF A needs 1e-09 Mcycles/s"),
    ],
)
def test_refuses_a_catalogue(types, vnfs, message):
    with pytest.raises(ScenarioError, match=message):
        ServiceCatalogue(tuple(ServiceType(name, (vnf,), 1.0, 1.0, weight) for name, vnf, weight in types), vnfs)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": " a"}, "has blanks around it"),
        ({"name": None}, "None is no name"),
        ({"name": "x" * 101}, "has 101 characters"),
        ({"chain": "NAT"}, "services.a.chain: 'NAT' is text; give a list"),
        ({"chain": ("NAT", 3)}, "services.a.chain: 3 is no name"),
        ({"rate": "1"}, "services.a.rate: '1' where a finite number"),
        ({"weight": True}, "services.a.weight: True where a finite number"),
        ({"weight": 1e200}, "services.a.weight: 1e\\+200; use 0 or"),
        ({"tolerable_delay": 1e200}, "services.a.tolerable_delay: 1e\\+200 ms"),
    ],
)
def test_refuses_values_from_python(changes, message):
    with pytest.raises(ScenarioError, match=message):
        ServiceType(**{"name": "a", "chain": ("NAT",), "rate": 1.0, "tolerable_delay": 9.0, **changes})


def test_names_that_become_one_tensorboard_tag():
    types = tuple(ServiceType(name, ("NAT",), 1.0, 9.0) for name in ("a b", "a_b"))
    with pytest.raises(ScenarioError, match="'a b' and 'a_b' have the one tag 'a_b'"):
        ServiceCatalogue(types)
