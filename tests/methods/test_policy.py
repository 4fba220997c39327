"""The method of an actor shows it what the environment shows, and carries its recurrent state."""

from __future__ import annotations

import numpy as np
import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from nfv_torchrl.evaluation.runner import run_method
from nfv_torchrl.methods import PolicyMethod
from nfv_torchrl.observations import RequestObservation
from nfv_torchrl.scenario import paper_scenario


class Counter(TensorDictModuleBase):
    """Takes the first valid action and counts its steps in a state that it is given back."""

    in_keys, out_keys = ["action_mask"], ["action", ("next", "count")]

    def __init__(self):
        super().__init__()
        self.counts = []

    def forward(self, tensordict):
        count = tensordict.get("count", torch.zeros(tensordict.batch_size)) + 1
        self.counts.append(int(count[0]))
        return tensordict.update({"action": tensordict["action_mask"].long().argmax(-1), "next": {"count": count}})


def test_a_policy_sees_what_the_environment_shows():
    seen = {}

    def first_valid(mask, observation, egress):
        seen.update(mask=mask, observation=observation, egress=egress)
        return mask.long().argmax(-1)

    keys = ["action_mask", "observation", ("request", "egress")]
    actor = TensorDictModule(first_valid, in_keys=keys, out_keys=["action"])
    scenario = paper_scenario(6, 0, horizon=4, arrival_rate=30, substrate={"vms_max": 2})
    records = run_method(scenario, PolicyMethod(actor, [RequestObservation()], one_hot=True), [0, 1])
    assert seen["mask"].shape == (2, 2 * 6 * 2 + 1) and seen["egress"].shape == (2,)
    plain = PolicyMethod(TensorDictModule(lambda mask: mask.long().argmax(-1), ["action_mask"], ["action"]))
    for record, other in zip(records, run_method(scenario, plain, [0, 1]), strict=True):
        for name in ("reason", "cost", "step_offsets", "step_node", "step_vm"):
            np.testing.assert_array_equal(getattr(record, name), getattr(other, name), err_msg=name)
        assert record.seconds > 0 and np.isfinite(record.decisions_per_second)


def test_a_recurrent_state_is_carried_and_dropped_at_the_start():
    actor = Counter()
    method = PolicyMethod(actor)
    scenario = paper_scenario(6, 0, horizon=5, arrival_rate=30)
    for _ in range(2):
        actor.counts.clear()
        run_method(scenario, method, [0])
        steps = actor.counts[1:]  # the first call warms up
        assert steps == list(range(1, len(steps) + 1))
