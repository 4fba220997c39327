"""The yaml configs, and the parser's strictness."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import toy
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import OmegaConf

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.scenario.config import ScenarioConfig, parse_config
from nfv_torchrl.scenario.scenario import Scenario, paper_scenario

CONFIGS = Path(__file__).parents[2] / "recipes" / "config"
NAMES = sorted(path.stem for path in (CONFIGS / "scenario").glob("[!_]*.yaml"))

SETTINGS = {  # N, V, lambda, mu, T, rho of seed 0
    "paper": (10, 6, 10, 600, 1000, 0.85),
    "paper_ranges": (10, 6, 10, 600, 1000, 0.99),
    "paper_20": (20, 6, 10, 600, 1000, 0.45),
    "paper_30": (30, 6, 10, 600, 1000, 0.28),
    "paper_50": (50, 6, 10, 600, 1000, 0.17),
    "paper_100": (100, 6, 10, 600, 1000, 0.09),
    "paper_memory": (10, 6, 10, 600, 1000, 0.85),
    "heavy": (10, 6, 25, 1200, 1000, 2.96),
    "heavy_20": (20, 6, 25, 1200, 1000, 1.58),
    "large": (100, 2, 25, 1200, 2000, 1.03),
    "abilene": (11, 4, 10, 600, 1000, 1.0),
    "geant": (34, 2, 15, 900, 1000, 1.0),
}


def composed(*overrides: str) -> Scenario:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = compose(overrides=list(overrides))
    return Scenario.from_config(OmegaConf.to_container(config.scenario, resolve=True))


# ---------------------------------------------------------------- yaml


OTHERS = ["cnupb", "virne"]  # as long and as loaded as the requests that they read


def test_all_are_listed_here():
    assert sorted([*SETTINGS, *OTHERS]) == NAMES


@pytest.mark.parametrize("name", SETTINGS)
def test_yaml_builds(name):
    scenario = composed(f"+scenario={name}")
    substrate = scenario.substrate
    actual = (substrate.num_nodes, substrate.max_vms, scenario.arrival_rate, scenario.mean_lifetime, scenario.horizon)
    assert (scenario.name, *actual) == (name, *SETTINGS[name][:-1])
    assert scenario.offered_load() == pytest.approx(SETTINGS[name][-1], abs=0.005)
    assert composed(f"+scenario={name}", "scenario.colocation=true").colocation


def test_cnupb_has_their_network_and_requests(monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])  # its requests are named from the folder that has docs/
    scenario = composed("+scenario=cnupb")
    requests = scenario.workload(0)
    assert (scenario.name, scenario.substrate.num_nodes, scenario.free_ends) == ("cnupb", 12, True)
    assert 1100 <= len(requests) <= 2000
    assert scenario.horizon > requests.slot[-1]


def test_virne_is_as_long_as_its_requests():
    files = Path(__file__).parent / "requests"
    scenario = composed(
        "+scenario=virne",
        f"scenario.workload.path={files / 'virne_set'}",
        f"scenario.substrate.path={files.parent / 'formats' / 'virne.gml'}",
    )
    assert (scenario.name, scenario.horizon, scenario.placement_rule, scenario.free_ends) == (
        "virne",
        8,
        "distinct",
        True,
    )
    assert {*scenario.substrate.link_unit_cost, *scenario.substrate.vm_unit_cost.ravel()} == {1.0}
    with pytest.raises(ScenarioError, match=r"horizon: is null, which means up to the last request of workload.path"):
        composed("+scenario=virne")


def test_base_yaml_says_what_the_dataclasses_say():
    base = OmegaConf.to_container(OmegaConf.load(CONFIGS / "scenario" / "_base.yaml"))
    assert parse_config(base) == ScenarioConfig()
    fields = ScenarioConfig.__dataclass_fields__
    assert set(base) == set(fields)
    for key in ("substrate", "workload", "failures"):
        assert set(base[key]) == set(fields[key].default_factory.__dataclass_fields__)


def test_the_yaml_is_the_papers_scenario():
    one, other = composed("+scenario=paper"), paper_scenario()
    np.testing.assert_array_equal(one.substrate.vm_capacity, other.substrate.vm_capacity)
    np.testing.assert_array_equal(one.endpoint_pairs, other.endpoint_pairs)
    assert one.catalogue == other.catalogue


def test_every_number_can_be_overridden():
    scenario = composed(
        "+scenario=paper",
        "scenario.seed=4",
        "scenario.arrival_rate=2.5",
        "scenario.substrate.nodes=12",
        "scenario.substrate.vm_capacity=[10,20]",
        "scenario.services.video.rate=2",
        "scenario.services.web.weight=0",
        "~scenario.services.voip",
        "+scenario.vnfs.DPI=3",
        "+scenario.services.game={chain:[DPI],rate:1,tolerable_delay:50}",
        "scenario.failures.p_repair=0.5",
    )
    assert (scenario.seed, scenario.arrival_rate, scenario.substrate.num_nodes) == (4, 2.5, 12)
    assert 10 <= scenario.substrate.vm_capacity.max() <= 20
    assert scenario.catalogue.names == ("web", "video", "game")
    assert scenario.catalogue.mix.tolist() == [0.0, 0.5, 0.5]
    assert scenario.catalogue.rate.tolist() == [0.1, 2.0, 1.0]
    assert scenario.failures.p_repair == 0.5


def own_scenario(folder: Path, text: str, *overrides: str) -> Scenario:
    """What a scenario file of one's own says, in a folder that Hydra searches besides."""
    (folder / "scenario").mkdir()
    (folder / "scenario" / "own.yaml").write_text(text)
    return composed(f"hydra.searchpath=[{folder.as_uri()}]", "+scenario=own", *overrides)


OWN = """
defaults: [_base, _self_]
name: own
services:
  gold: {chain: [FW, NAT], rate: 10, tolerable_delay: 50}
"""


def test_own_services_replace_the_papers(tmp_path):
    assert own_scenario(tmp_path, OWN).catalogue.names == ("gold",)


def test_own_services_can_be_overridden_and_added_to(tmp_path):
    silver = "+scenario.services.silver={chain:[FW],rate:1,tolerable_delay:9}"
    catalogue = own_scenario(tmp_path, OWN, "scenario.services.gold.rate=3", silver).catalogue
    assert dict(zip(catalogue.names, catalogue.rate.tolist(), strict=True)) == {"gold": 3.0, "silver": 1.0}


def test_a_file_without_services_has_the_papers(tmp_path):
    scenario = own_scenario(tmp_path, "defaults: [_base, _self_]\nname: own\n")
    assert scenario.catalogue == paper_scenario().catalogue


def test_a_file_may_take_the_papers_services_and_change_one(tmp_path):
    text = "defaults: [_base, services: paper, _self_]\nservices: {web: {rate: 5}}\n"
    catalogue = own_scenario(tmp_path, text, "~scenario.services.voip").catalogue
    assert dict(zip(catalogue.names, catalogue.rate.tolist(), strict=True)) == {"web": 5.0, "video": 4.0}


def test_changing_a_service_that_is_not_there_says_how(tmp_path):
    with pytest.raises(ScenarioError, match=r"services.web.chain: is missing; .* `- services: paper` in its defaults"):
        own_scenario(tmp_path, OWN, "+scenario.services.web.rate=5")


@pytest.mark.parametrize(
    ("yaml", "message"),
    [
        ('services: {"gold ": {chain: [FW], rate: 1, tolerable_delay: 9}}', "'gold ' has blanks around it"),
        ("services: {no: {chain: [FW], rate: 1, tolerable_delay: 9}}", "False is no name .*quotes"),
        ("services: {a: {chain: [no], rate: 1, tolerable_delay: 9}}", r"a.chain\[0\]: False where text"),
        ("vnfs: {on: 1}", "scenario.vnfs: True is no name"),
        ("services: {1: {chain: [FW], rate: 1, tolerable_delay: 9}}", "1 is no name; .*quotes"),
        ('services: {"": {chain: [FW], rate: 1, tolerable_delay: 9}}', "empty name"),
        ('services: {"a/b": {chain: [FW], rate: 1, tolerable_delay: 9}}', "has a '/'"),
        ('services: {"a\\nb": {chain: [FW], rate: 1, tolerable_delay: 9}}', "not printable"),
        ("services: {a: {chain: [FW], rate: .nan, tolerable_delay: 9}}", "a.rate: nan where a finite number"),
        ('services: {a: {chain: [FW], rate: "1", tolerable_delay: 9}}', "a.rate: '1' where a finite number"),
        ("colocation: maybe", "colocation: 'maybe' where true or false"),
    ],
)
def test_names_and_words_of_yaml(tmp_path, yaml, message):
    with pytest.raises(ScenarioError, match=message):
        own_scenario(tmp_path, f"defaults: [_base, _self_]\n{yaml}\n")


def test_hydra_refuses_an_unknown_key():
    with pytest.raises(HydraException, match="lamda"):
        composed("+scenario=paper", "scenario.lamda=3")


# ---------------------------------------------------------------- sources of a substrate


def make_toy(seed: int, scale: float = 1.0):
    return toy.toy_substrate().scale_vm_capacity(scale + seed)


def make_nonsense(seed: int):
    return {"seed": seed}


def make_an_impossible_one(seed: int):
    return toy.toy_substrate().scale_vm_capacity(-1)


def generator_config(function, **arguments) -> dict:
    return {"generator": {"_target_": f"{__name__}.{function.__name__}", **arguments}}


def test_a_generator_of_ones_own():
    scenario = paper_scenario(seed=2, substrate=generator_config(make_toy, scale=3.0))
    assert scenario.substrate.name == "toy"
    assert scenario.substrate.vm_capacity[0, 0] == 5 * 40.0


@pytest.mark.parametrize(
    ("substrate", "message"),
    [
        (generator_config(make_nonsense), "make_nonsense returned a dict; it must return a"),
        (generator_config(make_an_impossible_one), "vm_capacity is -40.0"),
        (generator_config(make_toy, colour="red"), "make_toy cannot be called"),
        ({"generator": {"_target_": "no.such.thing"}}, "no.such.thing cannot be called"),
        ({"generator": {"scale": 1}}, "substrate.generator: needs _target_"),
        ({**generator_config(make_toy), "path": "abilene"}, "both path and generator"),
        ({"path": "atlantis"}, "'atlantis' is neither a file"),
        ({"path": "nowhere.json"}, "nowhere.json: no such file"),
        ({"nodes": 1}, "nodes: 1"),
        ({"vms_min": 3, "vms_max": 2}, r"vms_min, vms_max: \[3, 2\] has low above high"),
        ({"vm_capacity": [-200, 1200]}, "vm_capacity: .* must be positive"),
        ({"target_rho": 0}, "target_rho: 0"),
        ({"path": "abilene", "detour": 0}, "detour: 0"),
    ],
)
def test_refuses_a_substrate(substrate, message):
    with pytest.raises(ScenarioError, match=message):
        paper_scenario(substrate=substrate)


def test_path_of_a_json_file(tmp_path):
    toy.toy_substrate().to_json(tmp_path / "toy.json")
    scenario = paper_scenario(substrate={"path": tmp_path / "toy.json"})
    assert scenario.substrate.name == "toy"


# ---------------------------------------------------------------- parser


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"arival_rate": 3}, "scenario.arival_rate: unknown key; did you mean 'arrival_rate'"),
        ({"zzz": 3}, "scenario.zzz: unknown key; known keys: name, seed, horizon"),
        ({"substrate": {"node": 3}}, "scenario.substrate.node: unknown key; did you mean 'nodes'"),
        ({"failures": {"p_fail": 3}}, "scenario.failures.p_fail: unknown key"),
        ({"workload": {"file": "x"}}, "scenario.workload.file: unknown key"),
        ({"services": {"web": {"speed": 3}}}, "scenario.services.web.speed: unknown key"),
        ({"services": {"web": {"rate": 1, "tolerable_delay": 3}}}, "scenario.services.web.chain: is missing"),
        ({"services": {"web": {"chain": "NAT", "rate": 1, "tolerable_delay": 3}}}, "web.chain: 'NAT' where a list"),
        ({"services": {"web": None}}, "scenario.services.web: is None"),
        ({"services": 3}, "scenario.services: is 3; a mapping or list"),
        ({"services": {}}, "services: there are none"),
        ({"services": [{"name": "a", "chain": ["NAT"], "rate": 1, "tolerable_delay": 9}] * 2}, "'a' is there twice"),
        ({"services": [{"chain": ["NAT"], "rate": 1, "tolerable_delay": 9}]}, "empty name"),
        ({"vnfs": {"NAT": "slow"}}, "scenario.vnfs.NAT: 'slow' where a finite number"),
        ({"vnfs": {"NAT": 1}}, "services.web.chain: unknown VNF 'FW'"),
        ({"vnfs": 3}, "scenario.vnfs: 3 where a mapping"),
        ({"horizon": 10.5}, "scenario.horizon: 10.5 where an integer"),
        ({"horizon": "long"}, "scenario.horizon: 'long' where an integer"),
        ({"horizon": True}, "scenario.horizon: True where an integer"),
        ({"horizon": None}, "horizon: is null"),
        ({"horizon": 0}, "horizon: 0"),
        ({"arrival_rate": float("nan")}, "scenario.arrival_rate: nan where a finite number"),
        ({"mean_lifetime": float("inf")}, "scenario.mean_lifetime: inf where a finite number"),
        ({"mean_lifetime": 10**400}, "where a finite number"),
        ({"colocation": "yes"}, "scenario.colocation: 'yes' where true or false"),
        ({"colocation": 1}, "scenario.colocation: 1 where true or false"),
        ({"mask": 3}, "scenario.mask: 3 where text"),
        ({"substrate": "abilene"}, "scenario.substrate: 'abilene' where a mapping"),
        ({"substrate": {"vm_capacity": [1, 2, 3]}}, r"vm_capacity: \[1, 2, 3\] where two numbers \[low, high\]"),
        ({"substrate": {"vm_capacity": 5}}, "vm_capacity: 5 where two numbers"),
        ({"substrate": {"vm_capacity": [1, None]}}, r"vm_capacity\[1\]: None where a finite number"),
        ({"failures": {"p_repair": 2}}, "failures.p_repair: 2.0 is no probability"),
        ({"seed": -1}, "integer >= 0"),
        (3, "scenario: is a int"),
    ],
)
def test_refuses(config, message):
    with pytest.raises(ScenarioError, match=message):
        Scenario.from_config(config)


def test_services_may_be_a_list():
    services = [{"name": "a", "chain": ["NAT"], "rate": 1, "tolerable_delay": 9}]
    assert paper_scenario(services=services).catalogue.names == ("a",)


def test_numbers_take_their_kind():
    config = parse_config({"horizon": 20.0, "arrival_rate": 3, "seed": np.int64(4)})
    assert (type(config.horizon), type(config.arrival_rate), type(config.seed)) == (int, float, int)


def test_a_config_object_will_do():
    assert Scenario.from_config(ScenarioConfig(seed=3)).seed == 3
