"""The table of TorchRL's classes in docs/losses.md: what TorchRL does by itself, what is put right, what is refused."""

import inspect
import math
import re
from functools import partial
from pathlib import Path

import pytest
import torch
import torchrl
import torchrl.objectives
from omegaconf import OmegaConf
from tensordict.nn import TensorDictModule
from torchrl.data import Categorical
from torchrl.modules import DistributionalQValueActor, MaskedCategorical, ProbabilisticActor
from torchrl.objectives import DiscreteCQLLoss, DiscreteIQLLoss, DiscreteSACLoss, DistributionalDQNLoss
from two_states import SIZES, TableNetwork, set_target, transition

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.losses import greedy_actor, request_loss, scorer
from nfv_torchrl.losses.policy_gradient import masked_actor, state_values
from nfv_torchrl.losses.torchrl_losses import FITS, MENDED
from nfv_torchrl.methods.compiled import CompiledCandidates, acting_method
from nfv_torchrl.networks import CandidateNetwork, MLPNetwork
from nfv_torchrl.settings.torchrl_losses import INSTEAD, OURS, SERVED, LossTarget, forget_other_loss, served

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

PAGE = (Path(__file__).parents[2] / "docs" / "losses.md").read_text()
ROWS = dict(re.findall(r"^\| `(\w+Loss)` \| (works|put right|refused) \|", PAGE, re.MULTILINE))
NETWORK = partial(MLPNetwork, hidden=(8,))
TABLE = [[0.5, 0.25, 7.0, 9.0], [0.1, 8.0, 0.3, 9.0]]
STEP = transition(action=1, mask=[1, 1, 0, 0], reward=0.5, next_mask=[1, 0, 1, 0], done=False)


def network(table=TABLE) -> TableNetwork:
    return TableNetwork(torch.tensor(table))


def values(key: str) -> TensorDictModule:
    return TensorDictModule(network(), in_keys=["observation"], out_keys=[key])


def ready(loss):
    loss.set_keys(done="request_done", terminated="request_done")
    loss.make_value_estimator(gamma=0.9)
    return loss


def test_the_page_has_every_class_and_this_version():
    assert f"for TorchRL {torchrl.__version__}," in PAGE
    kinds = {name: getattr(torchrl.objectives, name) for name in ROWS}
    assert {kinds[name] for name, what in ROWS.items() if what != "refused"} == set(FITS)
    assert {kinds[name] for name, what in ROWS.items() if what == "put right"} == set(MENDED)
    refused = {f"{kinds[name].__module__}.{name}" for name, what in ROWS.items() if what == "refused"}
    assert refused == set(INSTEAD)
    assert {f"{kind.__module__}.{kind.__name__}" for kind in FITS} == set(SERVED)


@pytest.mark.parametrize("name", [name for name, what in ROWS.items() if what == "refused"] + ["TD3Loss"])
def test_refused_by_name(name):
    with pytest.raises(ScenarioError, match=rf"loss\._target_: torchrl\.objectives\.\w+\.{name} does not serve here"):
        served(getattr(torchrl.objectives, name))


# ------------------------------------------------------------------- what TorchRL's classes do by themselves


def test_distributional_masks_distributions_by_the_mask_of_actions():
    module = TensorDictModule(
        network(torch.zeros(2, 3, 4).tolist()), in_keys=["observation"], out_keys=["action_value"]
    )
    support = torch.linspace(-1, 1, 3)
    actor = DistributionalQValueActor(
        module, support=support, spec=Categorical(4), action_space="categorical", action_mask_key="action_mask"
    )
    with pytest.raises((RuntimeError, NotImplementedError)):
        DistributionalDQNLoss(actor, gamma=0.9)(torch.cat([STEP, STEP]))


def test_cql_never_asks_its_target_network():
    loss = ready(DiscreteCQLLoss(greedy_actor(network(), 4), action_space="categorical"))
    before = loss(STEP.clone())
    set_target(loss, "value_network", [[100.0] * 4] * 2)
    after = loss(STEP.clone())
    assert torch.equal(before["target_value"], after["target_value"])
    assert after["pred_value"].item() == -math.inf


def test_iql_leaves_the_weights_of_rows_out():
    parts = [masked_actor(network(), 4), values("state_action_value"), state_values(network())]
    loss = ready(DiscreteIQLLoss(*parts, action_space="categorical"))
    rows = torch.cat([STEP, STEP.clone().set("action", torch.tensor([0]))])
    weighted = rows.clone().set("priority_weight", torch.tensor([1.0, 0.0]))
    assert torch.equal(loss(rows)["loss_qvalue"], loss(weighted)["loss_qvalue"])


def test_sac_is_nan_where_an_action_is_impossible():
    actor = ProbabilisticActor(
        TensorDictModule(network(), in_keys=["observation"], out_keys=["logits"]),
        in_keys={"logits": "logits", "mask": "action_mask"},
        out_keys=["action"],
        distribution_class=MaskedCategorical,
        spec=Categorical(4),
    )
    loss = ready(DiscreteSACLoss(actor, values("action_value"), action_space="categorical", num_actions=4))
    assert loss(STEP.clone())["loss_actor"].isnan()
    assert loss.target_entropy.item() > math.log(2)  # more than two valid actions can have


# --------------------------------------------------------------------------------------------- settings

SAMPLES = {
    "num_qvalue_nets": 3,
    "delay_value": True,
    "reduction": "sum",
    "loss_function": "l1",
    "loss_critic_type": "l1",
    "stop_at": "done",
    "atoms": 5,
    "v_min": -3,
    "v_max": 2,
    "alpha_init": 0.5,
    "min_alpha": 0.1,
    "max_alpha": 2,
    "target_entropy": "auto",
    "samples_mc_entropy": 2,
    "clip_epsilon": [0.1, 0.3],
    "clip_value": 1,
    "max_importance_ratio": 10,
    "entropy_coeff": 0,
    "critic_coeff": 1,
    "gamma": 1,
    "lmbda": 1,
    "temperature": 2,
    "expectile": 0.7,
    "target_entropy_weight": 0.5,
}
"""A value for every setting that is not true or false."""


@pytest.mark.parametrize("kind", FITS)
def test_every_setting_is_one_of_torchrls_and_works(kind):
    base = SERVED[f"{kind.__module__}.{kind.__name__}"]
    theirs = {name for each in kind.__mro__ for name in inspect.signature(each.__init__).parameters}
    assert set(base.settings) <= theirs | set(OURS)
    given = {name: SAMPLES.get(name, True) for name in base.settings}
    spec = {"_target_": f"torchrl.objectives.{kind.__name__}", **given}
    LossTarget(base.learns_from).check(spec, "loss", "")
    loss = request_loss(kind)(NETWORK, SIZES, **given)
    assert loss.actor(STEP.clone())["action"].item() in (0, 1)
    assert scorer(loss.actor) is not None


@pytest.mark.parametrize(
    ("target", "more", "recipe", "named"),
    [
        ("DQNLoss", {"duble_dqn": True}, "memory", r"loss\.duble_dqn: unknown key; did you mean 'double_dqn'"),
        ("ClipPPOLoss", {"clip_epsilom": 0.1}, "present", r"loss\.clip_epsilom: unknown key"),
        ("A2CLoss", {"functional": True}, "present", r"loss\.functional: unknown key"),
        ("DQNLoss", {"gamma": 2}, "memory", r"loss\.gamma: 2 where a finite number from 0 to 1"),
        ("DiscreteSACLoss", {"reduction": "none"}, "memory", r"loss\.reduction: 'none'"),
        ("ClipPPOLoss", {}, "memory", r"loss\._target_: ClipPPOLoss learns from .* use recipes/policy_gradient\.py"),
        ("DQNLoss", {}, "present", r"loss\._target_: DQNLoss learns from a replay memory; use recipes/dqn\.py"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_key(target, more, recipe, named):
    with pytest.raises(ScenarioError, match=named):
        LossTarget(recipe).check({"_target_": f"torchrl.objectives.{target}", **more}, "loss", "")


def test_another_class_on_the_command_line_leaves_settings_of_the_former_out():
    before = {"_target_": "torchrl.objectives.DQNLoss", "gamma": 0.95, "double": True, "n": 3}
    config = OmegaConf.create({"loss": before})
    forget_other_loss(config, ["loss._target_=torchrl.objectives.DQNLoss", "+loss.n=3", "seed=1"])
    assert dict(config.loss) == {key: before[key] for key in ("_target_", "gamma", "n")}  # n is then refused
    config = OmegaConf.create({"loss": before})
    forget_other_loss(config, ["loss.gamma=0.95"])
    assert dict(config.loss) == before


def test_the_loops_of_compiled_play_take_a_policy_of_torchrls_class():
    loss = request_loss(torchrl.objectives.DQNLoss)(partial(CandidateNetwork, hidden=(8,)), SIZES)
    assert isinstance(acting_method(loss.actor, loss.actor[0].module, one_hot=False), CompiledCandidates)
