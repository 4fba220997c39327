"""``PlanEnv``: menus by hand, TorchRL's contract, exact resumes, and the same walks as the planners'."""

import copy
import random
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import toy
from gymnasium.utils.env_checker import check_env
from hypothesis import example, given, settings
from hypothesis import strategies as st
from reference import ReferenceSimulator
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs

from nfv_torchrl.codec import decode_action
from nfv_torchrl.errors import CheckpointError, ScenarioError
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.gym import NFVGymEnv
from nfv_torchrl.gym.plans import PlanGymEnv, PlanVectorEnv
from nfv_torchrl.losses import greedy_actor
from nfv_torchrl.methods import PlannerMethod, load_policy
from nfv_torchrl.methods.base import WholePlay
from nfv_torchrl.methods.planned import planner_method
from nfv_torchrl.networks import MenuNetwork, MLPNetwork, Sizes
from nfv_torchrl.observations.menu_layout import ROW, ROW_SERVICE, SCALE, SERVICE, STATE, MenuShape
from nfv_torchrl.planners import MyopicPlanner, PricedPlanner
from nfv_torchrl.planners.priced import fill_prices
from nfv_torchrl.plans import MenuPlanner, Menus, PlanEnv
from nfv_torchrl.plans.acting import Acting, closest_of_others, fill_rules, level_at, refusing_at
from nfv_torchrl.plans.planner import PER_STAY
from nfv_torchrl.rewards import admission_regret
from nfv_torchrl.search.cheapest import plan_cheapest, plan_within
from nfv_torchrl.search.walks import Prices
from nfv_torchrl.simulator import Reason, Simulator
from nfv_torchrl.simulator.compiled import kernel
from nfv_torchrl.simulator.steps import find_link
from nfv_torchrl.testing import check_planner
from nfv_torchrl.testing.worlds import full_scenario
from nfv_torchrl.training.decisions import PlanDecisions

POLICY = Path(__file__).parents[1] / "docs" / "results" / "policies" / "plans_0.pt"

pytestmark = pytest.mark.filterwarnings("ignore:The env passed to Collector:FutureWarning")

LOADED = {"horizon": 20, "arrival_rate": 4.0, "mean_lifetime": 30.0}


def worlds(**changes):
    """Three networks of different sizes, with colocation on and off, that fill up."""
    return [
        full_scenario(colocation=colocation, seed=seed, substrate={"nodes": nodes}, **LOADED, **changes)
        for seed, (nodes, colocation) in enumerate([(5, False), (6, True), (4, False)])
    ]


def masked_random(seed: int = 0) -> TensorDictModule:
    generator = torch.Generator().manual_seed(seed)

    def act(mask: torch.Tensor) -> torch.Tensor:
        return torch.multinomial(mask.float(), 1, generator=generator).squeeze(-1)

    return TensorDictModule(act, in_keys=["action_mask"], out_keys=["action"])


def rollout(env: PlanEnv, steps: int, seed: int = 0) -> TensorDict:
    return env.rollout(steps, masked_random(seed), break_when_any_done=False)


def assert_same(one: TensorDict, other: TensorDict) -> None:
    for key in one.keys(True, True):
        assert torch.equal(one[key].nan_to_num(-1.0), other[key].nan_to_num(-1.0)), key


# ------------------------------------------------------------------------------------------------------- menus


def toy_env(**options) -> PlanEnv:
    """Two duos that come one after the other, on the network that fits on paper."""
    env = PlanEnv(toy.toy_scenario(), 1, menus=Menus([0.0, 10.0]), **options)
    env.reset()
    env.simulator.start(0, toy.workload_of(*[(0, toy.DUO, 0, 3, 5.0)] * 4))
    env._stale[:] = True
    return env


def test_a_menu_by_hand():
    """Mean unit cost of the six VMs: 16 / 6 = 2.67 $, so the second level charges a full resource 26.7 $ more."""
    env = toy_env()
    cost, _, actions = toy.DUO_0_TO_3
    seen = env._observe()
    menu = env.menus.menu
    assert menu.cost[0, 0] == cost and menu.action[0, 0, : menu.steps[0, 0]].tolist() == actions
    # On an empty network prices are unit costs: both levels have the same walk, offered once.
    assert seen["action_mask"].tolist() == [[True, False, True]]
    # It is played whole, and pays in full: nothing is cheaper.
    after = env.step(TensorDict({"action": torch.tensor([0])}, [1]))["next"]
    assert after["reward"].item() == 1.0 and after["request_done"].item() and after["outcome", "accepted"].item()
    assert after["outcome", "request_cost"].item() == cost == after["outcome", "step_cost"].item()
    # VM 1.0 is a quarter full, 2.0 two fifths and the links at a tenth or less. M^u is 3000^(1/4) = 7.4 and
    # 3000^(2/5) = 24.6, so with M = 3000 the second level adds 26.7 * 6.4 / 2999 = 0.06 $ and 0.21 $: too little.
    assert after["action_mask"].tolist() == [[True, False, True]]
    env.step(TensorDict({"action": torch.tensor([0])}, [1]))
    # Now 1.0 is half full (+ 0.48 $) and 2.0 four fifths (+ 5.4 $): B no longer fits on 2.0. The cheapest walk
    # bounces between 1 and 2, for 77 $.
    assert menu.cost[0, 0] == toy.DUO_0_TO_3_THIRD[0]
    assert menu.action[0, 0, : menu.steps[0, 0]].tolist() == toy.DUO_0_TO_3_THIRD[2]


@pytest.mark.parametrize("places", [None, 1, 3])
def test_what_is_kept_of_requests_is_what_would_be_found_anew(places):
    """Descriptions by one ``Menus``, which keeps where requests can go, and by a new one for each state; also where
    requests take each other's places all the time."""
    env = PlanEnv(worlds(), 6)
    needs = env.menus.view.needs
    if places is not None:
        fewer = needs._replace(kept_code=needs.kept_code[:places], kept=needs.kept[:places])
        env.menus.view = env.menus.view._replace(needs=fewer)
    for seed in range(4):
        rollout(env, 10, seed)
        anew = Menus()
        anew.prepare(env.simulator.world)
        for world, mine in env._worlds(np.arange(6)):
            anew.make(world, mine)
            env.menus.make(world, mine)
        np.testing.assert_array_equal(env.menus.flat, anew.flat)
        assert anew.flat.any(axis=1).all()


def test_what_is_seen_by_hand():
    env = toy_env()
    shape = MenuShape.of(2, 2)
    flat = env._observe()["observation"][0]
    state, row = flat[: shape.state], flat[shape.state : shape.state + shape.row]
    assert flat.shape == (shape.size,) and not flat[shape.state + shape.row :].any()  # the second walk is the first
    # Chains load 30 and 20 Mcycles/s: 25 on average.
    assert state[STATE.demand] == pytest.approx(30 / 25) and state[STATE.stay] == 1.0
    assert state[STATE.near] == pytest.approx(295 / 1050)
    assert state[STATE.vm_used] == 0.0 and state[STATE.offered_walks] == 0.5
    # 15 Mbit/s leave node 0; the mean rate is 1.5 Mbit/s.
    assert state[STATE.ingress_room] == pytest.approx(np.log(1 + 15 / 1.5) / 8)
    assert (
        row[ROW.regret] == 0.0 and row[ROW.delay] == pytest.approx(945 / 1050) and row[ROW.hops] == pytest.approx(0.3)
    )
    # A on 1.0 leaves 30 of 40 Mcycles/s, B on 2.0 leaves 30 of 50.
    assert row[ROW.vm_room] == pytest.approx(np.log(1 + 30 / 25) / 8) == pytest.approx(row[ROW.vm_room_least])
    # Duos from 0 to 3 may use nodes 1, 2 and 3, where B fits on all VMs: 290 Mcycles/s, of which this walk takes 30.
    service, left = state[len(STATE) :][SERVICE.close], row[len(ROW) :]
    close, closer = 1 / (1 + 290 / 30 / 4), 1 / (1 + 260 / 30 / 4)
    assert service == pytest.approx(close) and left[ROW_SERVICE.room_least] == pytest.approx(np.log(1 + 260 / 30) / 8)
    assert left[ROW_SERVICE.closer] == pytest.approx(closer - close) == pytest.approx(left[ROW_SERVICE.closer_most])
    # None of the latest requests is a solo.
    assert left[len(ROW_SERVICE) :].tolist() == [0.0, 0.0, 0.0, 1.0]
    env.step(TensorDict({"action": torch.tensor([0])}, [1]))
    after = env._observe()["observation"][0]
    row = after[shape.state : shape.state + shape.row]
    assert after[STATE.vm_used] == pytest.approx(30 / 330)
    # A third of the load on a VM that is a quarter full, the rest on one that is two fifths full.
    assert row[ROW.vm_used] == pytest.approx(0.25 / 3 + 0.4 * 2 / 3)


@given(st.integers(0, 10_000), st.booleans())
@example(577, False)  # two walks that cost the same
@example(5356, False)  # a horizon that has ended
@settings(max_examples=12)
def test_every_level_has_the_walk_of_the_rule_at_that_price(seed, colocation):
    """The levels that were not searched, too."""
    scenario = full_scenario(colocation=colocation, seed=seed % 7, admission_control=True)
    env = PlanEnv(scenario, 2, stagger=True, seed=seed)
    env.reset()
    world = env.simulator.world
    mean = world.tables.vm_unit_cost[0].sum() / world.tables.vm_count[0].sum()
    plans, lengths = np.zeros((2, world.rules.max_steps), np.int64), np.zeros(2, np.int64)
    menu = env.menus.menu
    for k, p in enumerate(env.menus.level):
        rule = PricedPlanner(price=p * mean, steepness=env.menus.steepness)
        rule.plan_rows(world, np.arange(2), plans, lengths)
        for b in range(2):
            if world.env["done"][b]:  # staggered into the end of its horizon: there is no request to plan
                continue
            offered = [j for j in range(k + 1) if menu.mask[b, j]]
            assert (lengths[b] > 0) == bool(offered)
            if not offered:
                continue
            # Of walks that cost the same either may be found; else they are the same.
            prices = Prices(np.zeros_like(world.tables.vm_unit_cost[0]), np.zeros_like(world.tables.link_unit_cost[0]))
            fill_prices(world, b, rule.rule, prices)
            costs = [_price_of(world, b, prices, menu.action[b, j], menu.steps[b, j]) for j in offered]
            least = _price_of(world, b, prices, plans[b], lengths[b])
            assert min(costs) == pytest.approx(least, rel=1e-9)
            assert not menu.mask[b, k] or costs[-1] == pytest.approx(least, rel=1e-9)


@kernel
def _price_of(world, b, prices, plan, steps):
    """What a walk costs at ``prices``."""
    tables, e = world.tables, world.env[b]
    here, i, cost = np.int64(e.ingress), 0, 0.0
    for j in range(steps):
        node, vm, places = decode_action(plan[j], tables.vm_capacity.shape[2])
        if node != here:
            cost += prices.link[find_link(tables, e.net, here, node)] * tables.rate[e.profile, i]
        if places:
            for kind in range(tables.load.shape[2]):
                cost += prices.vm[node, vm, kind] * tables.load[e.profile, i, kind]
            i += 1
        here = np.int64(node)
    return cost


def test_a_limit_leaves_the_cheapest_walk_as_it_is():
    """A search among walks that cost at most what the cheapest costs finds it; just below that there is none."""
    env = PlanEnv(worlds(), 3, stagger=True, seed=3)
    env.reset()
    world, own, found = env.simulator.world, env.menus.own.search, 0
    plan, limited = np.zeros((2, world.rules.max_steps), np.int64)
    for b in range(3):
        unit = Prices(world.tables.vm_unit_cost[b], world.tables.link_unit_cost[b])
        steps = plan_cheapest(world, b, unit, own, plan)
        cost = own.result[0]
        if steps == 0:
            continue
        found += 1
        assert _plan_within(world, b, unit, cost * (1 + 1e-9), own, limited) == steps
        assert limited[:steps].tolist() == plan[:steps].tolist()
        assert _plan_within(world, b, unit, cost * (1 - 1e-6), own, limited) == 0
    assert found


@kernel
def _plan_within(world, b, prices, limit, scratch, plan):
    return plan_within(world, b, prices, limit, scratch, plan)


# ------------------------------------------------------------------------------------------------- environment


@pytest.mark.parametrize("batch_size", [1, 7])
@pytest.mark.parametrize("options", [{}, {"stagger": True, "segment": 4}])
def test_specs(options, batch_size):
    failing = {"failures": {"p_fail_vm": 0.02, "p_fail_link": 0.02, "p_repair": 0.2}, "observe_lifetime": True}
    env = PlanEnv(worlds(**failing), batch_size, **options)
    check_env_specs(env)
    data = rollout(env, 120)
    after = data["next"]
    assert after["done"].any() and (after["request_done"] | after["done"]).all()
    assert after["observation"].isfinite().all() and after["reward"].isfinite().all()
    assert env.observation_spec.contains(env.reset().select(*env.observation_spec.keys(True, True)))
    reasons = set(after["outcome", "reason"][after["request_done"]].tolist())
    assert reasons <= {-1, Reason.REJECTED_BY_POLICY} and len(reasons) == 2
    assert (env._least_cost[~np.isnan(env._least_cost)] > 0).all()


def test_a_walk_that_is_not_offered_answers_with_invalid_action():
    env = PlanEnv(worlds(), 3)
    for action in (1, -1, 6, 99):  # on an empty network all levels have one walk
        env.reset()
        after = env.step(TensorDict({"action": torch.full((3,), action)}, [3]))["next"]
        assert (after["outcome", "reason"] == Reason.INVALID_ACTION).all() and not after["reward"].any()


def test_the_reward_is_that_of_the_known_part():
    scenario = worlds()[1]
    env = PlanEnv(scenario, 6, stagger=True, reward=lambda outcome, scale: admission_regret(outcome, scale, w_cost=0.5))
    data = rollout(env, 60)
    shape = MenuShape.of(2, 5)
    rows = data["observation"][..., shape.state :].unflatten(-1, (shape.rows, shape.row))
    action = data["action"].clamp(max=4)[..., None, None].expand(*data.shape, 1, shape.row)
    regret = rows.gather(-2, action).squeeze(-2)[..., ROW.regret]
    accepted = data["next", "outcome", "accepted"].squeeze(-1)
    known = torch.where(accepted, 1 - 0.5 * regret, 0.0)
    assert torch.allclose(data["next", "reward"].squeeze(-1), known, atol=1e-5) and regret.max() > 0
    with pytest.raises(ScenarioError, match="env=plans"):
        gym = NFVGymEnv(scenario, reward=admission_regret)
        gym.reset()
        gym.step(np.int64(0))


def test_level_zero_is_myopic_optimal_and_the_audit_agrees():
    """Requests, answers and costs of the cheapest walks are those of the planner, whose runs are audited."""
    for scenario in worlds()[:2]:
        env = PlanEnv(scenario, 1)
        cheapest = TensorDictModule(lambda mask: mask.int().argmax(-1), in_keys=["action_mask"], out_keys=["action"])
        data = env.rollout(1000, cheapest)[0]["next"]
        (record,) = run_method(
            scenario,
            PlannerMethod(MyopicPlanner(), name="myopic"),
            [0],
            workloads=[scenario.workload(0, 0, 0)],
        )
        ended = data["request_done"].flatten()
        assert data["outcome", "accepted"].flatten()[ended].tolist() == record.accepted.tolist()
        costs = data["outcome", "request_cost"].flatten()[ended].numpy()[record.accepted]
        np.testing.assert_allclose(costs, record.cost[record.accepted], rtol=1e-6)
        assert 0 < record.accepted.mean() < 1
    check_planner(MenuPlanner())  # walks any plan of it, and audits a horizon


def test_the_reference_agrees_with_random_choices():
    for b, scenario in enumerate(worlds()[:2]):
        env = PlanEnv(scenario, 1, seed=b)
        env.reset()
        scenario = scenario.replace(admission_control=True)
        reference = ReferenceSimulator(scenario, scenario.workload(b, 0, 0))
        rng, menu = random.Random(b), env.menus.menu
        while not reference.done:
            mask = env._observe()["action_mask"][0].tolist()
            k = rng.choice([k for k, offered in enumerate(mask) if offered])
            walk = [env.simulator.num_actions - 1] if k == 5 else menu.action[0, k, : menu.steps[0, k]].tolist()
            for action in walk:
                brought = reference.step(action)
            after = env.step(TensorDict({"action": torch.tensor([k])}, [1]))["next"]
            assert brought["accepted"] == after["outcome", "accepted"].item() == (k < 5)
            assert brought["request_cost"] == pytest.approx(after["outcome", "request_cost"].item(), rel=1e-6)
        assert after["done"].item()


def test_a_saved_state_goes_on_to_the_bit():
    env = PlanEnv(worlds(), 4, seed=2, stagger=True, segment=5)
    rollout(env, 37)
    state = copy.deepcopy(env.state_dict())
    resumed = PlanEnv(worlds(), 4, stagger=True, segment=5)
    resumed.load_state_dict(state)
    first = rollout(resumed, 60, seed=4)
    env.load_state_dict(state)
    assert_same(rollout(env, 60, seed=4), first)
    with pytest.raises(CheckpointError):
        env.load_state_dict({**state, "episode": state["episode"][:2]})
    assert_same(rollout(env, 5, seed=1), rollout(resumed, 5, seed=1))  # as they were


def test_a_collector_and_a_seed():
    batches = []
    for _ in range(2):
        env = PlanEnv(worlds(), 3, seed=5, stagger=True)
        collector = Collector(env, masked_random(1), frames_per_batch=60, total_frames=120)
        batches.append(torch.cat([batch.clone() for batch in collector], 1))
        collector.shutdown()
    assert_same(batches[0].exclude("collector"), batches[1].exclude("collector"))
    assert batches[0]["next", "done"].any()


def test_levels_are_checked():
    for levels in ([], [1.0, 2.0], [0.0, 2.0, 2.0], [0.0, float("inf")]):
        with pytest.raises(ScenarioError, match="levels"):
            Menus(levels)


# ----------------------------------------------------------------------------------------------------- policies


def trained(network, scenario, scale=2.0, **settings):
    """An actor with weights that are not zero."""
    torch.manual_seed(0)
    planner = MenuPlanner(**settings)
    sizes = planner.sizes(Simulator(scenario, 1))
    made = network(sizes)
    with torch.no_grad():
        for weights in made.parameters():
            weights.add_(scale * torch.randn_like(weights) / max(weights.shape[-1], 1) ** 0.5)
    return planner.follow(greedy_actor(made, sizes.actions))


BY_USE = {"compare_at": 1.0, "compare_full": 30.0, "between": 0.25, "refusing": 0.5}
ALL = BY_USE | {"refusing_full": 0.9, "reserve": 4.0}


@pytest.mark.parametrize(
    ("form", "number", "seen", "settings"),
    [
        ("price", 1, False, {}),
        ("free", 1, False, {}),
        ("price", 2, False, {"compare_at": 16.0}),
        ("price", 2, False, BY_USE),
        ("free", 2, False, BY_USE),
        ("price", 2, True, ALL),
        ("free", 2, False, ALL),
        ("price", 1, False, ALL),
    ],
)
def test_the_compiled_policy_chooses_as_torch_does(form, number, seen, settings):
    scenario = worlds()[number].replace(observe_lifetime=seen)
    planner = trained(lambda sizes: MenuNetwork(sizes, hidden=[8, 8], form=form), scenario, **settings)
    assert planner._prices is not None
    compiled, slow = PlannerMethod(planner, name="compiled"), copy.copy(planner)
    slow._prices = None
    whole = planner_method(planner, name="whole")  # a horizon in a call
    assert isinstance(whole, WholePlay) and not isinstance(planner_method(slow, name="slow"), WholePlay)
    records = [run_method(scenario, method, [0, 1]) for method in (compiled, whole, PlannerMethod(slow, name="slow"))]
    for one, same, other in zip(*records, strict=True):
        np.testing.assert_array_equal(one.cost, same.cost)
        assert (one.accepted == other.accepted).all() and (one.step_node == other.step_node).all()
        refused = one.reason == Reason.REJECTED_BY_POLICY
        assert 0 < one.accepted.mean() < 1 and refused.any()
    check_planner(planner)


def test_any_network_plays_and_an_untrained_one_takes_the_cheapest_walk():
    scenario = worlds()[0]
    check_planner(trained(lambda sizes: MLPNetwork(sizes, hidden=[8]), scenario), scenario=scenario)
    planner = MenuPlanner()
    sizes = planner.sizes(Simulator(scenario, 1))
    planner.follow(greedy_actor(MenuNetwork(sizes), sizes.actions))
    mine, best = (
        run_method(scenario, PlannerMethod(method, name="x"), [3])[0] for method in (planner, MyopicPlanner())
    )
    np.testing.assert_array_equal(mine.cost, best.cost)


@pytest.mark.parametrize("number", [0, 1])
def test_an_untrained_policy_that_compares_at_a_level_is_the_rule_at_that_price(number):
    """Without bid prices the walk of least cost at level p is that of ``priced``; with colocation true costs decide."""
    scenario = worlds()[number]
    simulator = Simulator(scenario, 1)
    mean_cost = simulator.tables.vm_unit_cost[0].sum() / simulator.tables.vm_count[0].sum()
    planner = MenuPlanner(compare_at=16.0)
    sizes = planner.sizes(simulator)
    planner.follow(greedy_actor(MenuNetwork(sizes), sizes.actions))
    rules = (planner, MyopicPlanner(), PricedPlanner(price=16.0 * mean_cost, steepness=3000.0))
    mine, cheapest, priced = (run_method(scenario, PlannerMethod(rule, name="x"), [3])[0].cost for rule in rules)
    assert not np.allclose(cheapest, priced, equal_nan=True)
    np.testing.assert_allclose(mine, cheapest if scenario.colocation else priced, rtol=1e-12)


def test_what_is_refused_does_not_depend_on_the_level_at_which_walks_are_compared():
    scenario = worlds()[2].replace(admission_control=True)
    by_cost, at_level = (
        trained(lambda sizes: MenuNetwork(sizes, hidden=[8, 8]), scenario, compare_at=level) for level in (0.0, 64.0)
    )
    simulator = Simulator(scenario, 1)
    simulator.start(0, scenario.workload(0))
    plans = np.zeros((2, 1, simulator.world.rules.max_steps), np.int64)
    row, lengths, answers = np.zeros(1, np.int64), np.zeros((2, 1), np.int64), []
    while not simulator.world.env["done"][0]:
        for planner, plan, length in zip((by_cost, at_level), plans, lengths, strict=True):
            planner.plan_rows(simulator.world, row, plan, length)
        answers.append((*lengths[:, 0], np.array_equal(*plans)))
        simulator.answer(plans[1], lengths[1])
    one, other, same = np.array(answers).T
    np.testing.assert_array_equal(one == 0, other == 0)
    assert 0 < (one == 0).mean() < 1 and not same[one > 0].all()


@kernel
def ask_rule(used, seen, own, acting, answers):
    """Level, share of the bid price in refusing, and how close another service's requests are to finding no room."""
    services = (seen.size - len(STATE)) // len(SERVICE)
    answers[2] = closest_of_others(seen, services, own)
    answers[0], answers[1] = level_at(used, acting), refusing_at(answers[2], acting)


def asked_rule(acting, used=0.0, room=(), own=0):
    seen, answers = np.zeros(len(STATE) + len(room) * len(SERVICE), np.float32), np.zeros(3)
    seen[len(STATE) + SERVICE.vm_room :: len(SERVICE)] = room
    ask_rule(used, seen, own, acting, answers)
    return answers.tolist()


@pytest.mark.parametrize("used", [0.0, 0.5, 1.0])
def test_the_level_at_which_walks_are_compared_rises_with_the_fourth_power_of_the_use(used):
    acting = Acting(empty=2.0, full=34.0, between=0.0, reserve=0.0, refusing=1.0, refusing_full=1.0)
    assert asked_rule(acting, used)[0] == {0.0: 2.0, 0.5: 4.0, 1.0: 34.0}[used]


def test_the_share_of_the_bid_price_that_refuses_rises_as_requests_of_other_services_find_no_room():
    """The rooms of three services: none, 4 chains (halfway to none), and more than is told apart."""
    acting = Acting(empty=0.0, full=0.0, between=0.0, reserve=0.0, refusing=0.2, refusing_full=1.0)
    rooms = (0.0, np.log(1 + 4.0) / SCALE, 1.0)
    assert asked_rule(acting, room=rooms, own=0)[1:] == pytest.approx([0.4, 0.5])
    for own in (1, 2):
        assert asked_rule(acting, room=rooms, own=own)[1:] == pytest.approx([1.0, 1.0])
    assert asked_rule(acting, room=rooms[:1])[1:] == pytest.approx([0.2, 0.0])  # there is no other


@pytest.mark.parametrize("compiled", [True, False])
def test_a_large_reserve_takes_the_walk_that_leaves_the_latest_requests_most(compiled):
    """Of the walks offered: the one whose largest steps towards no room, of each service, sum to the least."""
    scenario = worlds()[1].replace(colocation=False)
    planner, by_cost = MenuPlanner(reserve=1e6), 0
    simulator = Simulator(scenario, 1)
    sizes = planner.sizes(simulator)
    planner.follow(greedy_actor(MenuNetwork(sizes), sizes.actions))
    if not compiled:
        planner._prices = None
    simulator.start(0, scenario.workload(0))
    plan = np.zeros((1, simulator.world.rules.max_steps), np.int64)
    length, row = np.zeros(1, np.int64), np.zeros(1, np.int64)
    while not simulator.world.env["done"][0]:
        planner.plan_rows(simulator.world, row, plan, length)
        menu, layout = planner.menus.menu, planner.menus.layout
        walks = planner.menus.flat[0, layout.state :].reshape(layout.rows, -1)
        steps = walks[:, len(ROW) :].reshape(layout.rows, sizes.services, -1)[..., ROW_SERVICE.closer_most].sum(-1)
        offered = np.flatnonzero(menu.mask[0, :-1])
        if offered.size:
            taken = [k for k in offered if np.array_equal(menu.action[0, k], plan[0])]
            assert steps[taken[0]] == pytest.approx(steps[offered].min(), abs=1e-6)
            by_cost += taken[0] == 0
        simulator.answer(plan, length)
    assert 0 < by_cost < simulator.world.env["cursor"][0]


@pytest.mark.parametrize("number", [0, 1])
def test_bid_prices_do_not_tell_walks_apart_where_none_of_them_counts_between(number):
    """Without refusals a trained policy is an untrained one, with functions apart; else its bid prices count."""
    scenario = worlds()[number]
    rule = {"compare_at": 1.0, "compare_full": 30.0, "between": 0.0, "refusing": 0.0}
    learned = trained(lambda sizes: MenuNetwork(sizes, hidden=[8, 8]), scenario, scale=8.0, **rule)
    untrained = MenuPlanner(**rule)
    sizes = untrained.sizes(Simulator(scenario, 1))
    untrained.follow(greedy_actor(MenuNetwork(sizes), sizes.actions))
    one, other = (run_method(scenario, PlannerMethod(policy, name="x"), [3])[0].cost for policy in (learned, untrained))
    assert np.array_equal(one, other, equal_nan=True) is (not scenario.colocation)


@pytest.mark.parametrize(("seen", "colocation"), [(False, False), (True, False), (False, True)])
def test_a_share_of_the_bid_prices_refuses_where_lifetimes_are_hidden_and_functions_apart(seen, colocation):
    scenario = worlds()[2].replace(observe_lifetime=seen, colocation=colocation)
    refused = []
    for share in (1.0, 0.1):
        policy = MenuPlanner(refusing=share)
        sizes = policy.sizes(Simulator(scenario, 1))
        network = MenuNetwork(sizes)
        network.price[-1].bias.data.fill_(2.0)  # twice what accepting a request of mean demand pays
        policy.follow(greedy_actor(network, sizes.actions))
        record = run_method(scenario, PlannerMethod(policy, name="x"), [3])[0]
        refused.append(int((record.reason == Reason.REJECTED_BY_POLICY).sum()))
    assert (refused[1] < refused[0]) is (not seen and not colocation)
    assert refused[1] <= refused[0]


@pytest.mark.parametrize(("seen", "colocation"), [(False, False), (True, False), (False, True)])
def test_the_share_that_refuses_a_request_is_that_of_the_other_services_room(seen, colocation):
    """Request by request, from what the policy sees; the whole where lifetimes are seen or functions may share."""
    scenario = worlds()[0].replace(observe_lifetime=seen, colocation=colocation, arrival_rate=8.0)
    planner, simulator = MenuPlanner(), Simulator(scenario, 1)
    acting = Acting(empty=0.0, full=0.0, between=0.0, reserve=0.0, refusing=0.2, refusing_full=1.0)
    simulator.start(0, scenario.workload(3))
    planner.prepare(simulator.world)
    world, menus, row = simulator.world, planner.menus, np.zeros(1, np.int64)
    plan, length, shares = np.zeros((1, world.rules.max_steps), np.int64), np.zeros(1, np.int64), []
    while not world.env["done"][0]:
        planner.plan_rows(world, row, plan, length)  # the cheapest walk
        counts = np.zeros((1, len(menus.level) + 1))
        fill_rules(world, row, menus.offers, acting, 1.0, counts)
        rooms = menus.flat[0, len(STATE) + SERVICE.vm_room : menus.layout.state : len(SERVICE)].astype(np.float64)
        own = simulator.tables.service[world.env["profile"][0]]
        others = np.delete(np.expm1(rooms * SCALE), own)
        expected = 1.0 if seen or colocation else 0.2 + 0.8 / (1 + others.min() / 4) ** 2
        assert counts[0, -1] == pytest.approx(expected)
        shares.append(counts[0, -1])
        simulator.answer(plan, length)
    assert bool(max(shares) > 2 * min(shares)) is (not seen and not colocation)


def test_values_by_hand():
    """Q of a walk: what it pays, and V, less demand times stay times price; of reject: V."""
    sizes = MenuPlanner([0.0, 1.0]).sizes(Simulator(worlds()[0], 1))
    network = MenuNetwork(sizes, hidden=[4], w_cost=0.5)
    with torch.no_grad():
        network.value[-1].bias.fill_(3.0)
        network.price[-1].bias.fill_(0.25)
    shape = network.shape
    seen = torch.zeros(shape.size)
    seen[STATE.demand], seen[STATE.stay] = 2.0, 0.5
    seen[shape.state + shape.row + ROW.regret] = 0.2
    assert network(seen).tolist() == pytest.approx([1 + 3 - 0.25, 1 - 0.5 * 0.2 + 3 - 0.25, 3])
    free = MenuNetwork(sizes, hidden=[4], form="free", outputs=3)
    with torch.no_grad():
        free.price[-1].bias.copy_(torch.tensor([0.0, 1.0, 2.0]))
    assert free(seen.expand(7, -1))[0, 0].tolist() == [1, 0, -1]


@pytest.mark.parametrize("form", ["price", "free"])
@pytest.mark.parametrize("outputs", [1, 3])
def test_values_of_one_action_each_are_those_among_all(form, outputs):
    """Values, and what they teach the weights."""
    torch.manual_seed(5)
    network = MenuNetwork(Sizes(observation=0, actions=4, services=2, candidate_features=0), outputs, form=form)
    for weights in network.parameters():
        torch.nn.init.normal_(weights, 0, 0.3)
    seen, action = torch.rand(8, network.shape.size), torch.arange(8).unsqueeze(-1) % 4
    among = network(seen).reshape(8, 4, outputs)[torch.arange(8), action.squeeze(-1)]
    taught = []
    for values in (network.values_of(seen, action), among):
        network.zero_grad()
        values.square().sum().backward()
        taught.append((values.detach(), [weights.grad.clone() for weights in network.parameters()]))
    torch.testing.assert_close(*taught, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("most", "seen"), [(None, 4), (50, 4), (4, 4), (2, 2)])
def test_a_network_with_more_nodes_than_training_had_is_seen_as_having_so_many(most, seen):
    scenario = toy.toy_scenario()
    assert scenario.substrate.num_nodes == 4
    planner = MenuPlanner([0.0, 10.0], most_nodes=most)
    network = MenuNetwork(planner.sizes(Simulator(scenario, 1)), hidden=[4])
    loss = SimpleNamespace(actor=greedy_actor(network, 3))
    learning = PlanDecisions(planner).environment(scenario, 1, loss, reward=admission_regret)
    for env in (PlanEnv(scenario, 1, menus=planner.menus), learning):
        assert env.reset()["observation"][0, STATE.nodes] == pytest.approx(np.log(seen) / 5)


@pytest.mark.parametrize(
    "setting",
    [
        {"most_nodes": 0},
        {"most_nodes": 2.5},
        {"per_stay": -1.0},
        {"compare_at": -1.0},
        {"compare_full": -1.0},
        {"compare_full": "x"},
        {"between": 1.5},
        {"between": True},
        {"refusing": -0.1},
        {"refusing": float("nan")},
        {"refusing_full": -0.1},
        {"reserve": -1.0},
        {"reserve": float("inf")},
    ],
)
def test_numbers_out_of_their_range_are_refused_by_name(setting):
    """In code as in recipes: a policy's file may give them, too."""
    [name] = setting
    with pytest.raises(ScenarioError, match=name):
        MenuPlanner(**setting)
    with pytest.raises(CheckpointError, match=name):
        load_policy(POLICY, full_scenario(), planner=setting)


@pytest.mark.parametrize(
    ("lifetime", "learned", "acting"), [(1.0, 0.75, 2.0), (2.0, 1.0, 4.0), (5.0, 1.75, 10.0), (100.0, 3.0, 20.0)]
)
def test_stays_are_charged_by_hand(lifetime, learned, acting):
    """The mean lifetime is 2 s. Learned: half a price, and half of one for each mean lifetime, of which 5 at most."""
    for seen, per_stay, charged in ((True, None, learned), (True, PER_STAY, acting), (False, PER_STAY, 1.0)):
        env = PlanEnv(toy.toy_scenario(observe_lifetime=seen), 1, menus=Menus([0.0, 10.0], per_stay=per_stay))
        env.reset()
        env.simulator.start(0, toy.workload_of((0, toy.DUO, 0, 3, lifetime)))
        env._stale[:] = True
        assert env._observe()["observation"][0, STATE.stay] == charged


@pytest.mark.parametrize("compiled", [True, False])
def test_a_policy_that_acts_charges_for_the_whole_stay(compiled):
    """A bid price of 0.25 for each unit of demand, which is 1.2: half the mean stay costs 0.6, twice the mean 2.4."""
    scenario = toy.toy_scenario(observe_lifetime=True, admission_control=True)
    taken = []
    for planner in (MenuPlanner([0.0, 10.0]), MenuPlanner([0.0, 10.0], per_stay=None)):
        sizes = planner.sizes(Simulator(scenario, 1))
        network = MenuNetwork(sizes, hidden=[4])
        torch.nn.init.constant_(network.price[-1].bias, 0.25)
        planner.follow(greedy_actor(network, sizes.actions))
        if not compiled:
            planner._prices = None
        requests = [toy.workload_of((0, toy.DUO, 0, 3, 4.0), (1, toy.DUO, 0, 3, 1.0))]
        method = planner_method(planner, name="x")
        taken.append(run_method(scenario, method, [0], workloads=requests)[0].accepted.tolist())
    assert taken == [[False, True], [True, True]]


def test_gymnasium_accepts_it_and_it_is_environment_0():
    scenario = worlds()[1].replace(horizon=5)
    check_env(PlanGymEnv(scenario), skip_render_check=True)
    gym, env, both = PlanGymEnv(scenario, seed=3), PlanEnv(scenario, 1, seed=3), PlanVectorEnv(2, scenario, seed=3)
    seen, info = gym.reset()
    both.reset()
    td, done, rng = env.reset(), False, random.Random(0)
    while not done:
        np.testing.assert_array_equal(td["observation"][0].numpy(), seen)
        np.testing.assert_array_equal(gym.action_masks(), td["action_mask"][0].numpy())
        k = rng.choice(np.flatnonzero(gym.action_masks()).tolist())
        seen, reward, done, _, info = gym.step(np.int64(k))
        together = both.step(np.array([k, 5]))
        last = together[4]["final_obs"] if done else together[0]
        np.testing.assert_array_equal(last[0], seen)
        td = env.step(td.set("action", torch.tensor([k])))["next"]
        assert reward == pytest.approx(td["reward"].item()) and info["accepted"] == td["outcome", "accepted"].item()
        td = td.exclude("reward")
