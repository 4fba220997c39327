"""``NFVEnv``: online service provisioning as a batched TorchRL environment. No rule of the model lives here."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from nfv_torchrl import rewards
from nfv_torchrl.errors import CheckpointError, ScenarioError
from nfv_torchrl.observations import MemoryObservation, ObservationPart, RequestObservation, read_observation
from nfv_torchrl.planners.loading import Loader
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.simulator import OUTCOME, Simulator
from nfv_torchrl.simulator.snapshot import restore_snapshot, take_snapshot
from nfv_torchrl.simulator.state import ACCEPTED, DONE, REASON, REQUEST_COST, REQUEST_DONE


class NFVEnv(EnvBase):
    """B networks that answer one request after the other, a step of Algorithm 3 per action.

    An episode is one horizon of T slots; ``done`` marks its end, ``request_done`` the end of a request. Environment b's
    requests depend on (seed, b, episode) alone, neither on B nor on the actions.

    Args:
        scenarios: one scenario, or several of the same services, horizon and rules; environment b lives in number
            ``b % len(scenarios)``.
        batch_size: B.
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
        ``request_done``, ``accepted`` bool [1]: of the last step. ``rejection_reason`` int64 [1]: a ``Reason``, -1 for
        none. ``request_cost`` [1]: phi of a request accepted with the last step, $. ``statistics`` [16]: the columns
        of ``nfv_torchrl.simulator.OUTCOME``. ``done``, ``terminated`` bool [1].

    Raises:
        ScenarioError: scenarios that do not fit together.
    """

    def __init__(
        self,
        scenarios: Scenario | Sequence[Scenario],
        batch_size: int = 1,
        *,
        reward: rewards.Reward | None = None,
        one_hot: bool = True,
        observations: Sequence[ObservationPart] | None = None,
        stagger: bool = False,
        segment: int | None = None,
        seed: int = 0,
        threads: int = 1,
    ) -> None:
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([batch_size]))
        self.simulator = Simulator(scenarios, batch_size, one_hot=one_hot, threads=threads)
        self.reward = reward or rewards.admission_step_cost
        self.cost_scale = rewards.cost_scale(self.simulator.tables, self.simulator.world.env["net"])
        self.parts = (RequestObservation(),) if observations is None else tuple(observations)
        self._loader = Loader(self.simulator) if stagger else None
        if segment is not None and (segment < 1 or not stagger):
            raise ScenarioError(f"segment is {segment}; it needs stagger and must be at least 1 slot, or null")
        self.segment = segment
        self._seed = seed
        self._episode = np.full(batch_size, -1, np.int64)
        self._leave_at = np.zeros(batch_size, np.int64)
        self._continue = False
        self._make_specs()

    @property
    def num_actions(self) -> int:
        """Actions with ``reject``, the last one."""
        return self.simulator.num_actions

    def _make_specs(self) -> None:
        batch, view = self.batch_size, self.simulator.world.seen
        spec = {
            "observation": Unbounded((*batch, view.flat.shape[1]), dtype=torch.float32),
            "action_mask": Binary(self.num_actions, shape=(*batch, self.num_actions), dtype=torch.bool),
            "request_done": Binary(1, shape=(*batch, 1), dtype=torch.bool),
            "accepted": Binary(1, shape=(*batch, 1), dtype=torch.bool),
            "rejection_reason": Unbounded((*batch, 1), dtype=torch.int64),
            "request_cost": Unbounded((*batch, 1), dtype=torch.float32),
            "statistics": Unbounded((*batch, len(OUTCOME)), dtype=torch.float32),
        }
        for part in self.parts:
            spec.update(part.specs(self.simulator))
        self.observation_spec = Composite(spec, shape=batch)
        self.action_spec = Categorical(self.num_actions, shape=batch, dtype=torch.int64)
        self.reward_spec = Unbounded((*batch, 1), dtype=torch.float32)
        flag = Binary(1, shape=(*batch, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag.clone(), terminated=flag.clone(), shape=batch)

    def _outcome_keys(self, outcome: torch.Tensor) -> dict[str, torch.Tensor]:
        """The named keys of ``outcome`` float64 [B, 16]."""
        return {
            "request_done": outcome[:, REQUEST_DONE, None] > 0,
            "accepted": outcome[:, ACCEPTED, None] > 0,
            "rejection_reason": outcome[:, REASON, None].to(torch.int64),
            "request_cost": outcome[:, REQUEST_COST, None].to(torch.float32),
            "statistics": outcome.to(torch.float32),
        }

    def _act(self, actions: np.ndarray) -> None:
        """Carry out ``actions`` int64 [B]."""
        self.simulator.step(actions)

    def _observe(self) -> TensorDictBase:
        """What a controller sees now, in tensors of its own."""
        return read_observation(self.simulator, self.parts)

    def _memories(self) -> list[MemoryObservation]:
        return [part for part in self.parts if isinstance(part, MemoryObservation)]

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._act(tensordict.get("action").numpy())
        outcome = torch.from_numpy(self.simulator.world.outcome)
        reward = self.reward(self.simulator.outcome, self.cost_scale)
        terminated = outcome[:, DONE, None] > 0
        done = terminated | self._segments_ended()
        for memory in self._memories():
            memory.keep(tensordict, done)
        return self._observe().update(
            {
                **self._outcome_keys(outcome),
                "reward": torch.from_numpy(np.asarray(reward, np.float32)).unsqueeze(-1),
                "done": done,
                "terminated": terminated,
            }
        )

    def _segments_ended(self) -> torch.Tensor:
        """Environments between two requests whose segment is over, bool [B, 1]."""
        if self.segment is None:
            return torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        world = self.simulator.world
        ended = (world.outcome[:, REQUEST_DONE] > 0) & (world.env["slot"] >= self._leave_at)
        return torch.from_numpy(ended).unsqueeze(-1)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        # The first reset after load_state_dict continues instead: a collector always begins with a reset.
        if not self._continue:
            self._start(self._rows_to_reset(tensordict))
        self._continue = False
        outcome = torch.from_numpy(self.simulator.world.outcome)
        # An horizon without any request is over before its first step; a root that is done would be reset for ever, so
        # that is said with the first step instead. Rows that are not reset keep what TorchRL has for them.
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        keys = {**self._outcome_keys(outcome), "done": done, "terminated": done.clone()}
        return self._observe().update(keys)

    def _rows_to_reset(self, tensordict: TensorDictBase | None) -> np.ndarray:
        partial = None if tensordict is None else tensordict.get("_reset", None)
        if partial is None:
            return np.arange(self.batch_size[0])
        return partial.reshape(self.batch_size[0]).nonzero().flatten().numpy()

    def _start(self, rows: np.ndarray) -> None:
        """The next horizon of each environment of ``rows``."""
        for b in rows.tolist():
            self._episode[b] += 1
            episode = int(self._episode[b])
            self.simulator.start(b, *self._arrivals(b, episode))
            if self._loader is not None:
                rng = generator(self._seed, Stream.START, b, episode)
                start_slot = int(rng.integers(self.simulator.scenario(b).horizon))
                self._loader.forward(b, start_slot, rng)
                self._leave_at[b] = start_slot + (self.segment or 0)
        for memory in self._memories():
            memory.forget(rows, self.batch_size[0])

    def _arrivals(self, b: int, episode: int):
        scenario = self.simulator.scenario(b)
        return (
            scenario.workload(self._seed, b, episode),
            scenario.failure_timeline(self._seed, b, episode),
        )

    def _set_seed(self, seed: int | None) -> None:
        self._seed = 0 if seed is None else int(seed)
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

    def load_state_dict(self, state_dict, *args, **kwargs) -> None:
        """Go on from ``state_dict()``: the next ``reset`` returns the saved state instead of a new horizon.

        Raises:
            CheckpointError: it belongs to another batch size, network or version.
        """
        episode = state_dict["episode"].numpy()
        if episode.shape != self._episode.shape:
            raise CheckpointError(
                f"the checkpoint holds {len(episode)} environments, this run has {len(self._episode)}; "
                "resume with the same number"
            )
        self._seed = int(state_dict["seed"])
        self._episode = episode.copy()
        self._leave_at = state_dict["leave_at"].numpy().copy()
        for b in range(self.batch_size[0]):
            self.simulator.load_arrivals(b, *self._arrivals(b, max(int(episode[b]), 0)))
        world = {name: tensor.numpy() for name, tensor in state_dict["world"].items()}
        self.simulator.world = restore_snapshot(self.simulator.world, world)
        for memory, kept in zip(self._memories(), state_dict["memories"], strict=True):
            memory.load_state_dict(kept)
        # A state from before the first reset has no horizon to go on with.
        self._continue = bool((episode >= 0).all())
