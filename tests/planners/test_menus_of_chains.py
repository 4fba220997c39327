"""Menus for requests whose ends are free, whose functions stand apart, and that bring what they ask for."""

import copy
from pathlib import Path

import numpy as np
import pytest
import torch
from general_cases import general_case, plan_and_play
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import Instance, general_instances
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from test_plans import assert_same, masked_random, rollout
from test_requests_apart import alike, look
from torchrl.envs.utils import check_env_specs

from nfv_torchrl.codec import encode_action
from nfv_torchrl.errors import CheckpointError, ScenarioError
from nfv_torchrl.evaluation.audit import audit_run
from nfv_torchrl.evaluation.metrics import compute_metrics
from nfv_torchrl.evaluation.records import write_run
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.evolution import Redrawn
from nfv_torchrl.losses import greedy_actor
from nfv_torchrl.methods import PlannerMethod, load_policy
from nfv_torchrl.methods.planned import planner_method
from nfv_torchrl.networks import MenuNetwork
from nfv_torchrl.observations.asked import ASKED
from nfv_torchrl.observations.menu_layout import ROW, ROW_SERVICE, SERVICE, STATE, MenuShape
from nfv_torchrl.planners import MyopicPlanner
from nfv_torchrl.plans import MenuPlanner, Menus, PlanEnv
from nfv_torchrl.scenario.kinds import Resource
from nfv_torchrl.scenario.scenario import Scenario, paper_scenario
from nfv_torchrl.scenario.services import FREE, ServiceCatalogue, ServiceType
from nfv_torchrl.scenario.substrate import Substrate
from nfv_torchrl.scenario.workload import Workload
from nfv_torchrl.search.loading import Loader
from nfv_torchrl.simulator import Reason, Simulator

pytestmark = pytest.mark.filterwarnings("ignore:The env passed to Collector:FutureWarning")
FILES = Path(__file__).parents[1] / "scenario" / "requests"

# ----------------------------------------------------------------------------------------------------- by hand


def three_nodes() -> Scenario:
    """A line 0 - 1 - 2, one VM of 10 a node at $1, $3 and $1.5, links of 5 at $1; ``small`` is 4 and 3 on two nodes."""
    substrate = Substrate(
        name="line", labels=tuple("abc"), vm_count=np.ones(3, np.int64), vm_capacity=np.full((3, 1), 10.0),
        vm_unit_cost=np.array([[1.0], [3.0], [1.5]]), links=np.array([[0, 1], [1, 2]]), link_capacity=np.full(2, 5.0),
        link_delay=np.zeros(2), link_unit_cost=np.ones(2), coordinates=None,
    )  # fmt: skip
    free = {"rate": 2.0, "tolerable_delay": None, "ingress": "any", "egress": "any"}
    services = (ServiceType("small", ("A", "B"), **free), ServiceType("large", ("A", "A", "A"), **free))
    catalogue = ServiceCatalogue(services, {"A": {"cpu": 4.0}, "B": {"cpu": 3.0}}, (Resource("cpu", False),))
    return Scenario("line", 0, substrate, catalogue, horizon=9, endpoints="uniform", placement="distinct")


def requests_of(*services: int) -> Workload:
    """One a slot, with both ends free, that stays."""
    service = np.array(services)
    ends = np.full(len(service), FREE)
    return Workload(np.arange(len(service)), service, ends, ends, np.full(len(service), 100.0))


def menu_env(*services: int, levels=(0.0,)) -> PlanEnv:
    env = PlanEnv(three_nodes(), 1, menus=Menus(levels))
    env.reset()
    env.simulator.start(0, requests_of(*services))
    env._stale[:] = True
    return env


def take(env: PlanEnv, choice: int) -> TensorDict:
    return env.step(TensorDict({"action": torch.tensor([choice])}, [1]))["next"]


def test_a_menu_by_hand():
    """A on 0 and B on 2 cost 4 + 4.5, and the way between them, through 1, 2 * 2: $12.5. B on 0 and A on 2 cost $13."""
    env = menu_env(0, 0, 0, 1)
    env._observe()
    menu = env.menus.menu
    go = [encode_action(0, 0, True, 1), encode_action(1, 0, False, 1), encode_action(2, 0, True, 1)]
    assert menu.cost[0, 0] == 12.5 and menu.action[0, 0, : menu.steps[0, 0]].tolist() == go
    after = take(env, 0)
    assert after["outcome", "accepted"].item() and after["outcome", "request_cost"].item() == 12.5
    # The same again: each VM has 10, each link 5. A third has no link to 1 left with more than 1, and B no room on A's.
    assert take(env, 0)["outcome", "accepted"].item()
    assert env._observe()["action_mask"].tolist() == [[False, True]]  # nothing but to refuse
    assert take(env, 1)["outcome", "reason"].item() == Reason.REJECTED_BY_POLICY


def test_what_is_seen_by_hand():
    env = menu_env(0, 1)
    shape = MenuShape.of(2, 1, asked=True)
    flat = env._observe()["observation"][0]
    state, row = flat[: shape.state], flat[shape.state :]
    assert flat.shape == (shape.size,) and len(row) == shape.row
    # Chains take 7 and 12: 9.5 on average. All three nodes are in reach, with 30, and A is the largest function.
    assert state[STATE.demand] == pytest.approx(7 / 9.5) and state[STATE.near] == 0
    assert state[STATE.ingress_room] == state[STATE.egress_room] == pytest.approx(np.log(1 + 10 / 2) / 8)  # at node 1
    # At mean unit costs: 7 at 5.5 / 3, and one hop of 2 Mbit/s at $1.
    assert state[STATE.least_cost] == pytest.approx(np.log(12.5 / (7 * 5.5 / 3 + 2)) / 3)
    of_small = state[len(STATE) :][: len(SERVICE)]
    assert of_small[SERVICE.close] == pytest.approx(1 / (1 + 30 / 7 / 4)) and of_small[SERVICE.link_room] == 1
    assert row[ROW.hops] == pytest.approx(0.2) and row[ROW.delay] == 0 and row[ROW.regret] == 0
    assert row[ROW.vm_room_least] == pytest.approx(np.log(1 + 6 / 9.5) / 8)
    assert row[ROW.link_room_least] == pytest.approx(np.log(1 + 3 / 2) / 8)
    left = row[len(ROW) :]
    assert left[ROW_SERVICE.closes] == 0 and left[ROW_SERVICE.room_least] == pytest.approx(np.log(1 + 23 / 7) / 8)
    asked = state[shape.state - len(ASKED) :]
    assert asked[ASKED.length] == pytest.approx(0.2) and asked[ASKED.haste] == asked[ASKED.fixed_delay] == 0
    assert asked[ASKED.free_start] == asked[ASKED.free_end] == 1
    assert asked[ASKED.share] == pytest.approx(7 / 30) and asked[ASKED.load_uneven] == pytest.approx(25 / 49)
    # One of three segments is carried; 10 Mbit/s are free. All segments carry 2, of chains with 3 and with 4.
    assert asked[ASKED.traffic] == pytest.approx(0.5 * np.log(2 / 7))
    assert asked[ASKED.traffic_share] == pytest.approx(2 / 10)
    assert asked[ASKED.traffic_uneven] == pytest.approx(1)
    # The second asks for more, at another place on its chain.
    take(env, 0)
    large = env._observe()["observation"][0]
    assert large[STATE.demand] == pytest.approx(12 / 9.5) and large[STATE.vm_used] == pytest.approx(7 / 30)
    of_large = large[len(STATE) :][len(SERVICE) : 2 * len(SERVICE)]
    assert of_large[SERVICE.close] == pytest.approx(1 / (1 + 23 / 12 / 4))


# -------------------------------------------------------------------------------------------- Virne's chains, tiny


def tiny_config(folder: Path, requests: int = 40) -> dict:
    """Chains of 2 to 4 functions on eight nodes, more than they hold."""
    laws = (
        (FILES / "virne_laws.yaml")
        .read_text()
        .replace("500}", "60}")
        .replace("num_v_nets: 500", f"num_v_nets: {requests}")
    )
    path = folder / f"laws_{requests}.yaml"
    path.write_text(laws.replace("high: 10}", "high: 4}").replace("lam: 0.14", "lam: 0.9"))
    chain = {"chain": ["f"], "rate": 25, "tolerable_delay": None, "ingress": "any", "egress": "any"}
    return {
        "name": "virne", "horizon": None, "endpoints": "uniform", "placement": "distinct", "mask": "feasible",
        "substrate": {"generator": {"_target_": "nfv_torchrl.scenario.waxman.draw_waxman", "nodes": 8, "beta": 1.0}},
        "resources": {"cpu": {"scales_with_rate": False}}, "vnfs": {"f": {"cpu": 10}}, "services": {"chain": chain},
        "workload": {"path": str(path)},
    }  # fmt: skip


@pytest.fixture
def config(tmp_path):
    return tiny_config(tmp_path)


def untrained(planner: MenuPlanner, scenario: Scenario) -> MenuPlanner:
    sizes = planner.sizes(Simulator(scenario, 1))
    return planner.follow(greedy_actor(MenuNetwork(sizes, hidden=[8]), sizes.actions))


@pytest.mark.parametrize("labels", [None, 30])
@pytest.mark.parametrize("levels", [[0.0], [0.0, 4.0]])
def test_an_untrained_policy_is_myopic_optimal(config, tmp_path, levels, labels):
    """Request by request, in ``PlanEnv`` and in the compiled planner, with and without a limit, and audited."""
    scenario = Scenario.from_config({**config, "seed": 3})
    best = PlannerMethod(MyopicPlanner(labels=labels), name="x")
    (exact,) = run_method(scenario, best, [0])
    planner = untrained(MenuPlanner(levels, labels=labels), scenario)
    whole, steps = planner_method(planner, name="x"), PlannerMethod(planner, name="x")
    for method in (whole, steps):
        (mine,) = run_method(scenario, method, [0])
        np.testing.assert_array_equal(mine.cost, exact.cost)
        np.testing.assert_array_equal(mine.step_node, exact.step_node)
        assert 0 < mine.accepted.mean() < 1
        if labels is None:
            assert planner.unproved is None
        elif len(levels) == 1:
            assert planner.unproved.tolist() == best.planner.unproved.tolist()
    write_run(tmp_path / "run", mine, compute_metrics(mine))
    assert not audit_run(tmp_path / "run").problems
    env = PlanEnv(scenario, 1, menus=Menus(levels, labels=labels))
    cheapest = TensorDictModule(lambda mask: mask.int().argmax(-1), in_keys=["action_mask"], out_keys=["action"])
    data = env.rollout(100, cheapest)[0]["next"]
    assert data["outcome", "accepted"].flatten().tolist() == exact.accepted.tolist()


def test_a_limit_that_is_met_is_counted_once_a_menu(config):
    scenario = Scenario.from_config({**config, "seed": 3})
    planner = untrained(MenuPlanner([0.0, 4.0, 64.0], labels=2), scenario)
    (record,) = run_method(scenario, planner_method(planner, name="x"), [0])
    assert 0 < planner.unproved[0] <= len(record.accepted)
    with pytest.raises(ScenarioError, match="labels is 0"):
        Menus(labels=0)


def test_a_policy_is_for_requests_that_are_described_alike(config):
    policies = Path(__file__).parents[2] / "docs" / "results" / "policies"
    scenario = Scenario.from_config({**config, "seed": 3})
    method = load_policy(policies / "chains_plans_0.pt", scenario)
    (record,) = run_method(scenario, method, [0])
    assert record.accepted.any() and method.planner.menus.labels == 10_000
    with pytest.raises(
        CheckpointError, match=r"chains_plans_0.pt was trained on virne.* by what they ask; those of paper"
    ):
        load_policy(policies / "chains_plans_0.pt", paper_scenario(5))
    with pytest.raises(
        CheckpointError, match=r"plans_0.pt was trained on heavy.* by their service; those of virne are"
    ):
        load_policy(policies / "plans_0.pt", scenario)


def pooled(config: dict, count: int = 3) -> list[Scenario]:
    return Redrawn(config, draws=4, substrates=count).scenarios(seed=0, count=8)


def test_environments_live_on_the_networks_of_several_draws(config):
    one, other, _ = worlds = pooled(config)
    assert len({world.seed for world in worlds}) == 3 and len(one.pool) == 4
    assert not np.array_equal(one.substrate.vm_capacity, other.substrate.vm_capacity)
    assert one.profiles is other.profiles and one.pool is other.pool
    assert one.replace(admission_control=True).pool is one.pool
    assert len(Redrawn(config, draws=4).scenarios(seed=0, count=8)) == 1 == len(pooled(config, 4)[:1])
    assert len(Redrawn(config, draws=4, substrates=3).scenarios(seed=0, count=2)) == 2
    with pytest.raises(ScenarioError, match=r"networks.substrates: 5; use 1 to networks.draws, 4"):
        Redrawn(config, draws=4, substrates=5)


@pytest.mark.parametrize("options", [{}, {"stagger": True, "segment": 30}])
def test_specs_and_a_saved_state_that_goes_on(config, options):
    menus = {"menus": Menus([0.0, 4.0], labels=100)}
    env = PlanEnv(pooled(config), 4, seed=2, **menus, **options)
    check_env_specs(env)
    before = rollout(env, 90)
    assert before["next", "observation"].isfinite().all() and before["next", "done"].any()
    reasons = set(before["next", "outcome", "reason"][before["next", "request_done"]].tolist())
    assert reasons == {-1, Reason.REJECTED_BY_POLICY}
    state = copy.deepcopy(env.state_dict())
    resumed = PlanEnv(pooled(config), 4, menus=Menus([0.0, 4.0], labels=100), **options)
    resumed.load_state_dict(state)
    first = rollout(resumed, 60, seed=4)
    env.load_state_dict(state)
    assert_same(rollout(env, 60, seed=4), first)


def test_an_environment_is_the_same_alone_and_in_a_batch(config):
    cheapest = TensorDictModule(lambda mask: mask.int().argmax(-1), in_keys=["action_mask"], out_keys=["action"])
    worlds = pooled(config)
    together = PlanEnv(worlds, 3, seed=1).rollout(50, cheapest, break_when_any_done=False)
    for b, world in enumerate(worlds):
        alone = PlanEnv(world, 1, seed=1)
        alone.first = b
        assert_same(alone.rollout(50, cheapest, break_when_any_done=False)[0], together[b])


def test_the_compiled_policy_chooses_as_torch_does(config):
    scenario = Scenario.from_config({**config, "seed": 3})
    planner = untrained(MenuPlanner([0.0, 4.0]), scenario)
    network = planner._actor.module[0].module
    torch.manual_seed(0)
    with torch.no_grad():
        for weights in network.parameters():
            weights.add_(0.3 * torch.randn_like(weights))
    planner.follow(planner._actor)
    slow = copy.copy(planner)
    slow._prices = None
    records = [run_method(scenario, planner_method(each, name="x"), [0])[0] for each in (planner, slow)]
    assert (records[0].accepted == records[1].accepted).all()
    assert (records[0].reason == Reason.REJECTED_BY_POLICY).any() and records[0].accepted.any()


def test_above_a_drawn_use_larger_requests_are_refused_while_loading(config):
    scenario = Scenario.from_config({**config, "seed": 3})
    loads = []
    for fullest in (None, (0.0, 0.0)):
        simulator = Simulator(scenario.replace(admission_control=True), 1, record=True)
        simulator.start(0, scenario.workload(0))
        Loader(simulator, fullest=fullest).forward(0, scenario.horizon, np.random.default_rng(0))
        accepted = simulator.world.log.reason[0, : len(scenario.file_workload)] < 0
        total = scenario.profiles.total[:, 0]
        loads.append((total[scenario.file_workload.profile[accepted]], total.mean()))
    # Once something runs, what is larger than the mean is refused; nothing runs when the first comes.
    (freely, mean), (chosen, _) = loads
    assert (freely[5:] > mean).any() and not (chosen[1:] > mean).any() and len(chosen) > 5


# ----------------------------------------------------------------------------------------- any request of the model


def test_no_two_requests_of_a_set_look_alike(config):
    """Small whole numbers, on an empty network."""
    scenario = Scenario.from_config({**config, "seed": 3})
    workload = scenario.workload(0)
    simulator = look(scenario, workload, list(range(len(workload))))
    menus = Menus([0.0])
    menus.prepare(simulator.world)
    menus.make(simulator.world, np.arange(len(workload)))
    assert alike(TensorDict({"menu": torch.from_numpy(menus.flat)}, [len(workload)]), "menu") == []


def test_the_cheapest_walk_of_any_request_is_the_planner_s():
    """Several kinds, free ends, rates of segments, full duplex, on networks that are nearly full."""
    described = 0
    for seed in range(80):
        planner = MenuPlanner([0.0, 8.0])
        assert plan_and_play(planner, general_case(seed)) == plan_and_play(MyopicPlanner(), general_case(seed))
        described += planner.menus.view.asked
        assert np.isfinite(planner.menus.flat).all()
    assert 20 < described < 80


@settings(max_examples=30)
@given(general_instances(max_requests=6), st.integers(0, 99))
def test_any_choice_of_any_menu_is_carried_out(instance: Instance, seed: int):
    scenario, workload, timeline = instance
    if scenario.step_budget == "slot" or scenario.placing_after_chain == "forwards":
        scenario = scenario.replace(step_budget="request", placing_after_chain="masked")
    env = PlanEnv(scenario, 1, menus=Menus([0.0, 8.0]))
    env.reset()
    env.simulator.start(0, workload, timeline)
    env._stale[:] = True
    choose = masked_random(seed)
    while not env.simulator.world.env["done"][0]:
        seen = env._observe()
        assert seen["observation"].isfinite().all()
        action = choose(seen.select("action_mask"))["action"]
        after = env.step(TensorDict({"action": action}, [1]))["next"]
        refused = action.item() == 2
        assert after["outcome", "accepted"].item() == (not refused)
