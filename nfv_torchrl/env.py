"""``NFVEnv``: online service provisioning as a batched TorchRL environment. No rule of the model lives here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Categorical, Composite, Unbounded

from nfv_torchrl import rewards
from nfv_torchrl.errors import CheckpointError, ScenarioError
from nfv_torchrl.lean_env import LeanEnv
from nfv_torchrl.observations import (
    KnowingPart,
    MemoryObservation,
    ObservationPart,
    RequestObservation,
    gather,
    outcome_spec,
    read_observation,
    read_outcome,
)
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.streams import LARGEST_SEED, Stream, check_seed, generator
from nfv_torchrl.search.loading import Loader
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.snapshot import restore_snapshot, take_snapshot
from nfv_torchrl.simulator.state import OUTCOME
from nfv_torchrl.state_checks import check_array, check_arrays, check_keys, check_list, check_whole

LAST_EPISODE = 2**53
"""More horizons than any environment plays; an episode's number in a checkpoint is below it."""


def batch_shape(batch_size: int | Sequence[int]) -> torch.Size:
    """``batch_size`` of an environment as a shape, of one dimension or none.

    Raises:
        ScenarioError: it has more.
    """
    shape = torch.Size([batch_size] if isinstance(batch_size, int | np.integer) else batch_size)
    if len(shape) > 1:
        raise ScenarioError(f"batch_size is {list(shape)}; an environment has one batch dimension, or none ([])")
    return shape


class ActionSpec(Categorical):
    """A ``Categorical`` that stays equal to itself when a transform (TorchRL's ``ActionMask``) puts a mask on it.

    ``TransformedEnv`` compares specs before it calls an environment's own ``rand_action``, which knows the mask.
    """

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Categorical):
            return False
        mine, theirs = self.clone(), other.clone()
        mine.mask = theirs.mask = None
        return Categorical.__eq__(mine, theirs)

    __hash__ = Categorical.__hash__


class NFVEnv(LeanEnv):
    """B networks that answer one request after the other. Each action is a step of Algorithm 3.

    An episode is one horizon of T slots; ``done`` marks its end, ``request_done`` the end of a request. Environment b's
    requests depend on (seed, b, episode) alone, neither on B nor on the actions.

    Args:
        scenarios: one scenario, or several of the same services, horizon and rules; environment b lives in number
            ``b % len(scenarios)``.
        batch_size: B, or ``torch.Size([B])``; or ``[]``, one environment without a batch dimension, as TorchRL's
            batches of environments (``ParallelEnv``, ``SerialEnv``) and its Gymnasium wrappers are made of.
        reward: see ``nfv_torchrl.rewards``; default ``admission_step_cost``.
        one_hot: append one-hot service type, current node, egress and function index to ``observation``.
        observations: further keys to emit; default the request's own numbers under ``request``.
        stagger: horizons begin at a random slot, on a network loaded by the exact search at noisy prices.
        segment: with ``stagger``, slots after which an environment leaves its horizon (``done``, not ``terminated``)
            for a new one at another random slot, so that learning sees many loads in little time; None: never.
        seed: first seed; ``set_seed`` sets another.
        threads: threads that split the batch inside the simulator; results do not depend on it.

    Keys (A = 2 N V actions and ``reject``, the last; float32, shapes after the batch dimension):
        ``observation`` [P]: used share of every VM and link, service, node, VM, function and delay (eq. of the
        network state), and the one-hot features. ``action_mask`` bool [A + 1]. ``action`` int64 []. ``reward`` [1].
        ``request_done`` bool [1]: the last step ended a request. ``outcome``, nested, [1] each: what else it brought,
        by the names in ``nfv_torchrl.simulator.state.Outcome``; ``accepted`` and ``passed`` bool, ``reason`` (a
        ``Reason``, -1 for none) and ``service`` int64. ``done``, ``terminated`` bool [1].

    Raises:
        ScenarioError: scenarios that do not fit together, or a batch size of several dimensions.
    """

    first = 0
    """Number of its first environment among all of a training that has more in other processes; set before a reset."""

    def __init__(
        self,
        scenarios: Scenario | Sequence[Scenario],
        batch_size: int | Sequence[int] = 1,
        *,
        reward: rewards.Reward | None = None,
        one_hot: bool = True,
        observations: Sequence[ObservationPart] | None = None,
        stagger: bool = False,
        segment: int | None = None,
        seed: int = 0,
        threads: int = 1,
    ) -> None:
        shape = batch_shape(batch_size)
        super().__init__(device=torch.device("cpu"), batch_size=shape)
        self.simulator = Simulator(scenarios, shape.numel(), one_hot=one_hot, threads=threads)
        self.reward = rewards.prepared(reward, self.simulator)
        self.cost_scale = rewards.cost_scale(self.simulator.tables, self.simulator.world.env["net"])
        self.parts = (RequestObservation(),) if observations is None else tuple(observations)
        self._knowing = [part for part in self.parts if isinstance(part, KnowingPart)]
        self._loader = Loader(self.simulator) if stagger else None
        if segment is not None and (segment < 1 or not stagger):
            raise ScenarioError(f"segment is {segment}; it needs stagger and must be at least 1 slot, or null")
        self.segment = segment
        check_seed(seed)
        self._seed = seed
        self._episode = np.full(shape.numel(), -1, np.int64)
        self._leave_at = np.zeros(shape.numel(), np.int64)
        self._continue = False
        self._make_specs()

    @property
    def num_actions(self) -> int:
        """The number of actions, with ``reject``, which is the last."""
        return self.simulator.num_actions

    def _make_specs(self) -> None:
        batch, view = self.batch_size, self.simulator.world.seen
        spec = {
            "observation": Unbounded((*batch, view.flat.shape[1]), dtype=torch.float32),
            "action_mask": Binary(self.num_actions, shape=(*batch, self.num_actions), dtype=torch.bool),
            "request_done": Binary(1, shape=(*batch, 1), dtype=torch.bool),
        }
        of_all = Composite(outcome=outcome_spec(self.simulator), shape=(self.simulator.batch_size,))
        for part in self.parts:
            of_all.update(part.specs(self.simulator))
        spec |= (of_all if batch else of_all[0]).items()
        self.observation_spec = Composite(spec, shape=batch)
        self.action_spec = ActionSpec(self.num_actions, shape=batch, dtype=torch.int64)
        self.reward_spec = Unbounded((*batch, 1), dtype=torch.float32)
        flag = Binary(1, shape=(*batch, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag.clone(), terminated=flag.clone(), shape=batch)

    def _act(self, actions: np.ndarray) -> None:
        """Carry out ``actions`` int64 [B]."""
        self.simulator.step(actions)

    def _outcome(self) -> Mapping[str, np.ndarray]:
        """What the last step brought, for the reward, float64 [B] by name, with what parts of the observation know of
        the request that it was about (``known``)."""
        outcome = self.simulator.outcome
        for part in self._knowing:
            outcome |= part.known()
        return outcome

    def _observe(self) -> TensorDictBase:
        """What a controller sees now, in tensors of its own."""
        return read_observation(self.simulator, self.parts)

    def _emit(self, values: dict) -> TensorDictBase:
        """``values``, [B] each, with what a controller sees now, in the batch size of the environment."""
        whole = gather(dict(self._observe().items()) | values, self.simulator.batch_size)
        return whole if self.batch_size else whole[0]

    def _memories(self) -> list[MemoryObservation]:
        return [part for part in self.parts if isinstance(part, MemoryObservation)]

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._act(tensordict.get("action").reshape(-1).numpy())
        reward = np.asarray(self.reward(self._outcome(), self.cost_scale), np.float32)
        if not np.isfinite(reward).all():
            raise ScenarioError(
                f"reward: {getattr(self.reward, '__name__', type(self.reward).__name__)} returned "
                f"{reward[~np.isfinite(reward)][0]}; return finite numbers, in every step"
            )
        values = read_outcome(self.simulator.world.outcome)
        terminated = values["done"]
        done = terminated.clone() if self.segment is None else terminated | self._segments_ended()
        for memory in self._memories():
            memory.keep(tensordict if self.batch_size else tensordict.unsqueeze(0), done)
        values |= {"reward": torch.from_numpy(reward).unsqueeze(-1), "done": done, "terminated": terminated}
        return self._emit(values)

    def _segments_ended(self) -> torch.Tensor:
        """Environments between two requests whose segment is over, bool [B, 1]."""
        world = self.simulator.world
        ended = (world.outcome[:, OUTCOME.request_done] > 0) & (world.env["slot"] >= self._leave_at)
        return torch.from_numpy(ended).unsqueeze(-1)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        # The first reset after load_state_dict continues instead: a collector always begins with a reset.
        if not self._continue:
            self._start(self._rows_to_reset(tensordict))
        self._continue = False
        # A horizon without any request is over before its first step; a root that is done would be reset for ever, so
        # that is said with the first step instead. Rows that are not reset keep what TorchRL has for them.
        done = torch.zeros(self.simulator.batch_size, 1, dtype=torch.bool)
        values = read_outcome(self.simulator.world.outcome) | {"done": done, "terminated": done.clone()}
        return self._emit(values)

    def _rows_to_reset(self, tensordict: TensorDictBase | None) -> np.ndarray:
        partial = None if tensordict is None else tensordict.get("_reset", None)
        if partial is None:
            return np.arange(self.simulator.batch_size)
        return partial.reshape(-1).nonzero().flatten().numpy()

    def _start(self, rows: np.ndarray) -> None:
        """The next horizon of each environment of ``rows``."""
        for b in rows.tolist():
            self._episode[b] += 1
            episode = int(self._episode[b])
            self.simulator.start(b, *self._arrivals(b, episode))
            if self._loader is not None:
                rng = generator(self._seed, Stream.START, self.first + b, episode)
                start_slot = int(rng.integers(self.simulator.scenario(b).horizon))
                self._loader.forward(b, start_slot, rng)
                self._leave_at[b] = start_slot + (self.segment or 0)
        for memory in self._memories():
            memory.forget(rows, self.simulator.batch_size)

    def _arrivals(self, b: int, episode: int):
        scenario = self.simulator.scenario(b)
        return (
            scenario.workload(self._seed, self.first + b, episode),
            scenario.failure_timeline(self._seed, self.first + b, episode),
        )

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """``action`` int64 [B], each one that the mask allows as likely; torch's seed decides.

        The mask is that of ``tensordict``, or the one that the environment shows now.
        """
        mask = None if tensordict is None else tensordict.get("action_mask", None)
        mask = self._emit({})["action_mask"] if mask is None else mask
        action = torch.multinomial(mask.reshape(-1, mask.shape[-1]).float(), 1).view(mask.shape[:-1])
        drawn = TensorDict({"action": action}, batch_size=action.shape)
        return drawn if tensordict is None else tensordict.update(drawn)

    def _set_seed(self, seed: int | None) -> None:
        seed = 0 if seed is None else seed
        check_seed(seed)
        self._seed = int(seed)
        self._episode[:] = -1
        self._continue = False

    def state_dict(self, *args, **kwargs) -> dict:
        """Everything that the next steps depend on, as tensors and numbers: books, walks, seeds and episodes."""
        snapshot = take_snapshot(self.simulator.world)
        return {
            "seed": self._seed,
            "episode": torch.from_numpy(self._episode.copy()),
            "leave_at": torch.from_numpy(self._leave_at.copy()),
            "world": {name: torch.from_numpy(array) for name, array in snapshot.items()},
            "memories": [memory.state_dict() for memory in self._memories()],
        }

    def load_state_dict(self, state_dict, strict: bool = True, **kwargs) -> None:
        """Go on from ``state_dict()``: the next ``reset`` returns the saved state instead of a new horizon.

        Args:
            state_dict: from anyone. Nothing of it is used before all of it has been checked; where it is refused, the
                environment is as it was.
            strict: refuse a state that lacks a part. False: leave the environment as it is then, since a part of a
                state is no place to go on from; TorchRL's ``EnvCreator`` hands such states over.

        Raises:
            CheckpointError: it belongs to another batch size, scenario or version, or is damaged.
        """
        if not strict and not self._state_keys() <= set(state_dict):
            return
        before = self._seed, self._episode, self._leave_at, self._continue, self.simulator.world
        try:
            self._load(state_dict)
        except BaseException:
            self._seed, self._episode, self._leave_at, self._continue, self.simulator.world = before
            raise

    def _state_keys(self) -> set[str]:
        return {"seed", "episode", "leave_at", "world", "memories"}

    def _load(self, state_dict) -> None:
        """Check the state and take it over, in new arrays, so that those of before can come back."""
        simulator = self.simulator
        batch = simulator.batch_size
        check_keys("env", state_dict, self._state_keys())
        episode = state_dict["episode"]
        if isinstance(episode, torch.Tensor) and episode.ndim == 1 and len(episode) != batch:
            raise CheckpointError(
                f"the checkpoint holds {len(episode)} environments, this run has {batch}; resume with the same number"
            )
        latest = simulator.scenario(0).horizon + (self.segment or 0)
        self._seed = check_whole("env.seed", state_dict["seed"], 0, LARGEST_SEED)
        self._episode = check_array("env.episode", episode, self._episode, -1, LAST_EPISODE)
        self._leave_at = check_array("env.leave_at", state_dict["leave_at"], self._leave_at, 0, latest)
        snapshot = check_arrays("env.world", state_dict["world"])
        memories = self._memories()
        kept = check_list("env.memories", state_dict["memories"], len(memories))
        simulator.world = simulator.world._replace(
            env=simulator.world.env.copy(),
            arrivals=type(simulator.world.arrivals)(*(array.copy() for array in simulator.world.arrivals)),
        )
        for b in range(batch):
            simulator.load_arrivals(b, *self._arrivals(b, max(int(self._episode[b]), 0)))
        simulator.world = restore_snapshot(simulator.world, snapshot, self._episode >= 0)
        values = [memory.check_state(state, batch) for memory, state in zip(memories, kept, strict=True)]
        for memory, value in zip(memories, values, strict=True):
            memory.load_state_dict(value)
        # A state from before the first reset has no horizon to go on with.
        self._continue = bool((self._episode >= 0).all())
