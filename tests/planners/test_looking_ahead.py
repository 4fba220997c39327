"""Look-ahead rows against worked answers and against trying every walk; the network that is made of them."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from exhaustive import Case, cheapest_by_trying, tight_case
from stepwise import StepByStep
from toy import DUO, DUO_0_TO_3, action, toy_catalogue, toy_scenario, toy_substrate, workload_of

from nfv_torchrl.codec import decode_action
from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.losses import greedy_actor
from nfv_torchrl.methods import PlannerMethod, PolicyMethod, WholePlay, acting_method
from nfv_torchrl.networks import LookaheadNetwork, Sizes
from nfv_torchrl.observations import LookaheadObservation
from nfv_torchrl.observations.candidates import FEATURES as CANDIDATE
from nfv_torchrl.observations.lookahead import FEATURES, ROW
from nfv_torchrl.observations.standing import FACTORS, STATE
from nfv_torchrl.planners import MyopicPlanner
from nfv_torchrl.rewards import admission_regret
from nfv_torchrl.scenario import paper_scenario
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.kernels import step_env
from nfv_torchrl.simulator.mask import write_masks
from nfv_torchrl.simulator.state import World
from nfv_torchrl.simulator.tables import Rules, build_tables
from nfv_torchrl.testing import check_observation

CASES = 25
BUSY = {"nodes": 6, "seed": 1, "horizon": 8, "arrival_rate": 25, "mean_lifetime": 1000}


def simulator_at(case: Case) -> SimpleNamespace:
    """What an observation reads, at the request of a case."""
    world: World = case.world
    world.env["node"] = case.ingress
    write_masks(world)
    return SimpleNamespace(world=world, tables=world.tables, batch_size=1, num_actions=world.seen.mask.shape[1])


def rows_of(observation: LookaheadObservation, simulator) -> dict[int, torch.Tensor]:
    """The rows in use by their action."""
    seen = observation.read(simulator)["lookahead"]
    used = seen["mask"][0]
    return dict(zip(seen["action"][0][used].tolist(), seen["features"][0][used], strict=True))


def test_the_toy_request_by_hand():
    tables = build_tables([toy_substrate()], toy_catalogue())
    case = Case(tables, Rules(False, False, False, 100), tables.vm_capacity[0, :, :, 0].copy(),
                tables.link_capacity[0].copy(), DUO, 0, 3)  # fmt: skip
    simulator, observation = simulator_at(case), LookaheadObservation()
    rows = rows_of(observation, simulator)
    assert observation.known()["least_cost"] == pytest.approx([55.0])
    best = rows[action(1, 0, True)]  # to node 1 for $2, A on its VM 0 for $10
    assert best[[ROW.fits, ROW.planned, ROW.spared]].tolist() == [1, 1, 1]
    assert best[[ROW.step_cost, ROW.cost, ROW.regret]].tolist() == pytest.approx([12 / 55, 1, 0])
    # A on VM 1 costs $40 more. The bound on the rest forgets the delay: B on VM 0 of node 3, by node 2, $23.
    dearer = rows[action(1, 1, True)]
    assert dearer[[ROW.cost, ROW.regret, ROW.planned]].tolist() == pytest.approx([75 / 55, 20 / 55, 0], abs=1e-6)
    # Straight to 2 and A there, $21: the same bound says $43, but nothing costs less than the cheapest walk.
    assert rows[action(2, 0, True)][ROW.cost] == 1
    assert rows[action(2, 0, True)][ROW.delay] == pytest.approx((220 + 200 + 130 + 250) / 1050)
    low = rows_of(LookaheadObservation(exact=False), simulator)
    assert low[action(2, 0, True)][ROW.cost] == pytest.approx(43 / 35)  # $35: A on 1.0 and B on 3.0, by 2, too late
    step_env(simulator.world, 0, action(1, 0, True))
    after = rows_of(observation, simulator)
    assert after[action(2, 0, True)][[ROW.planned, ROW.cost]].tolist() == [1, 1]
    assert DUO_0_TO_3[0] == 55.0


@pytest.mark.parametrize("colocation", [False, True])
def test_costs_are_those_of_trying_every_walk(colocation):
    """At every step of random walks: exact for the planned row, a bound for the others; kept and worked out anew
    alike."""
    planned = infeasible = 0
    for seed in range(CASES):
        case, rng = tight_case(seed, colocation), np.random.default_rng(seed)
        # At raised prices that are not raised both plans are the cheapest, whichever of them the walk goes on with.
        simulator, exact, bounds = simulator_at(case), LookaheadObservation(price=0), LookaheadObservation(exact=False)
        kept = LookaheadObservation()
        path: list[tuple[int, int, bool]] = []
        vms = case.vm_offered.shape[1]
        while True:
            rows, low = rows_of(exact, simulator), rows_of(bounds, simulator)
            known, fresh = rows_of(kept, simulator), rows_of(LookaheadObservation(), simulator)
            assert all(torch.equal(known[each], fresh[each]) for each in known) and known.keys() == fresh.keys()
            scale, loose = (each.known()["least_cost"][0] for each in (exact, bounds))
            best = cheapest_by_trying(case, tuple(path))
            if not path:
                assert scale == pytest.approx(best) and loose <= best + 1e-9
            fit = [row for row in rows.values() if row[ROW.fits]]
            assert bool(fit) == (best < math.inf)
            infeasible += not fit
            steps = [each for each in rows if each != len(simulator.world.seen.mask[0]) - 1]
            for each in steps:
                if rows[each][ROW.planned]:
                    assert rows[each][ROW.cost] * scale == pytest.approx(best, rel=1e-5)
                    planned += 1
            some = int(rng.choice(steps))
            node, vm, place = decode_action(some, vms)
            truth = cheapest_by_trying(case, (*path, (node, vm, place)))
            if truth < math.inf:
                assert rows[some][ROW.fits] and low[some][ROW.fits]
                for row, least in ((rows[some], scale), (low[some], loose)):
                    assert row[ROW.cost] >= 20 or row[ROW.cost] * least <= truth * (1 + 1e-5)
            step_env(simulator.world, 0, some)
            if not simulator.world.outcome[0, 0] or simulator.world.outcome[0, 2]:  # did not pass, or ended the request
                break
            path.append((node, vm, bool(place)))
    assert planned > CASES // 2 and infeasible > 2


def test_the_egress_is_packed():
    """Of a walk that is at its egress even the bounds are exact: all that is left goes on the VMs of one node."""
    packed = 0
    for seed in range(60):
        case = tight_case(seed, False)
        case = case._replace(ingress=case.egress, tables=case.tables._replace(tolerable_delay=np.array([1e9])))
        observation = LookaheadObservation(exact=False)
        rows_of(observation, simulator_at(case))
        expected = cheapest_by_trying(case)
        assert observation.known()["least_cost"][0] == pytest.approx(expected)
        packed += expected < math.inf and case.tables.chain_length[0] > 1
    assert packed > 5


def busy_scenario(**changes):
    return paper_scenario(mask="feasible", admission_control=True, **(BUSY | changes))


def untrained(scenario, **settings):
    sizes = Sizes.of(Simulator(scenario, 1))
    network = LookaheadNetwork(sizes, **settings)
    return network, greedy_actor(network, sizes.actions)


@pytest.mark.parametrize("colocation", [False, True])
def test_untrained_it_is_the_exact_search(colocation):
    scenario = busy_scenario(colocation=colocation)
    network, actor = untrained(scenario)
    for method in (acting_method(actor, network, one_hot=False), PolicyMethod(actor, network.observations())):
        mine = run_method(scenario, method, [0])[0]
        best = run_method(scenario, PlannerMethod(MyopicPlanner(), name="myopic"), [0])[0]
        np.testing.assert_array_equal(mine.cost, best.cost)
        np.testing.assert_array_equal(mine.step_vm, best.step_vm)


@pytest.mark.parametrize("exact", [True, False])
def test_the_compiled_network_decides_as_torch_does(exact):
    scenario = busy_scenario()
    network, actor = untrained(scenario, hidden=[8], exact=exact)
    torch.manual_seed(1)
    with torch.no_grad():
        for weights in network.prices[-1].parameters():
            weights.add_(0.1 * torch.randn_like(weights))
        network.prices[-1].bias[1] += 0.6  # most videos are refused
    compiled = acting_method(actor, network, one_hot=False)
    assert type(compiled).__name__ == "CompiledLookahead"
    assert isinstance(compiled, WholePlay)
    ways = (compiled, StepByStep(compiled), PolicyMethod(actor, network.observations()))
    whole, *others = (run_method(scenario, method, [0, 1]) for method in ways)
    for records in others:
        for one, other in zip(whole, records, strict=True):
            assert (one.accepted == other.accepted).all() and (one.step_node == other.step_node).all()
            assert 0 < one.accepted.mean() < 1


def test_values_by_hand():
    sizes = Sizes(observation=1, actions=4, services=1, candidate_features=0)
    network = LookaheadNetwork(sizes, hidden=[4], w_cost=0.5)
    with torch.no_grad():
        network.value[-1].bias.fill_(3.0)
        network.prices[-1].bias.copy_(torch.tensor([2.0, 0.25]))  # lambda and g
    features, state = torch.zeros(4, len(FEATURES)), torch.zeros(len(STATE))
    state[STATE.demand], state[STATE.stay] = 2.0, 1.0
    features[0, ROW.reject] = 1
    for row, (cost, regret, spare_cost, spare_regret, is_planned) in enumerate(
        [(1.0, 0.3, 1.0, 0.3, 1), (1.4, 0.0, 1.2, 0.1, 0)], 1
    ):
        features[row, ROW.fits], features[row, ROW.planned] = 1, is_planned
        features[row, ROW.cost], features[row, ROW.priced_regret] = cost, regret
        features[row, ROW.spare_cost], features[row, ROW.spare_regret] = spare_cost, spare_regret
    mask = torch.tensor([True, True, True, False])
    values = network(features, torch.tensor([3, 0, 2, 3]), mask, state, torch.ones(4, dtype=torch.bool))
    # V + 1 - 0.5 (cost - 1) - 2 regret - 2 * 0.25, of the better way; reject: V; no row: 0.
    assert values.tolist() == pytest.approx([3 + 1 - 0.6 - 0.5, 0, 3 + 1 - 0.2 - 0.5, 3], abs=1e-4)
    assert FACTORS == 2


@pytest.mark.parametrize(("at_once", "pull"), [(0.5, -6.0), (0.0, -2.0)])
def test_a_bid_for_three_mean_stays_by_hand(at_once, pull):
    """The demand is 2 and the bid 0.25, so 1.5 are paid. Paid in proportion, the bid learns as from a mean stay."""
    sizes = Sizes(observation=1, actions=2, services=1, candidate_features=0)
    network = LookaheadNetwork(sizes, hidden=[4], at_once=at_once)
    torch.nn.init.constant_(network.prices[-1].bias, 0.25)
    features, state = torch.zeros(1, len(FEATURES)), torch.zeros(len(STATE))
    state[STATE.demand], state[STATE.stay] = 2.0, 3.0
    features[0, ROW.fits] = features[0, ROW.planned] = features[0, ROW.cost] = features[0, ROW.spare_cost] = 1
    mask = torch.ones(2, dtype=torch.bool)
    value = network(features, torch.tensor([0]), mask[:1], state, mask)[0]
    value.backward()
    assert value.item() == pytest.approx(1 - 1.5) and network.prices[-1].bias.grad[1].item() == pull


@pytest.mark.parametrize(("at_once", "charged"), [(0.5, (1.0, 0.75, 3.0)), (0.0, (1.0, 0.5, 5.0))])
def test_a_bid_is_for_the_demand_and_where_lifetimes_are_seen_for_the_stay(at_once, charged):
    """A duo takes 30 Mcycles/s and services 25 on average. The mean lifetime is 2 s, and 5 of these are the most."""
    for shown, stays in ((False, (1.0, 1.0, 1.0)), (True, charged)):
        simulator = Simulator(toy_scenario(mask="feasible", observe_lifetime=shown), 3)
        for b, lifetime in enumerate((2.0, 1.0, 100.0)):
            simulator.start(b, workload_of((0, DUO, 0, 3, lifetime)))
        state = LookaheadObservation(at_once=at_once).read(simulator)["lookahead"]["state"]
        assert state[:, STATE.demand].tolist() == pytest.approx([1.2] * 3)
        assert state[:, STATE.stay].tolist() == pytest.approx(stays)
        assert state[:, STATE.log_demand].tolist() == pytest.approx([0.5 * math.log(1.2)] * 3)


def test_rewards_know_the_least_cost():
    """What a request pays is 1 less a tenth of what its walk costs above the cheapest one."""
    scenario = toy_scenario(mask="feasible", horizon=2)
    env = NFVEnv(scenario, 1, reward=admission_regret, observations=[LookaheadObservation()])
    env._arrivals = lambda b, episode: (workload_of((0, DUO, 0, 3, 2.0), (0, DUO, 0, 3, 2.0)), None)
    td = env.reset()
    paid = []
    for each in (action(1, 1, True), action(2, 0, True), action(3), *DUO_0_TO_3[2]):
        td = env.step(td.set("action", torch.tensor([each])))["next"]
        paid.append(td["reward"].item())
        td = td.exclude("reward")
    assert paid == pytest.approx([0, 0, 1 - 0.1 * 40 / 55, 0, 0, 1.0])


def test_it_is_an_observation_and_refuses_what_it_does_not_know():
    check_observation(LookaheadObservation)
    both = LookaheadObservation(candidates=True)
    simulator = Simulator(busy_scenario(), 1)
    assert both.shape(simulator.tables, simulator.world.rules)[1] == len(FEATURES) + len(CANDIDATE) + 3
    with pytest.raises(ScenarioError, match="placement"):
        LookaheadObservation().read(Simulator(paper_scenario(nodes=4, placement="distinct"), 1))
