"""Who acts in a training, and where: this process, further processes, or a Ray cluster; a recipe's ``collector``.

Environment b has the same requests wherever it lives, because they depend on the seed and on b alone.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import BaseCollector, Collector, MultiAsyncCollector, MultiSyncCollector

from nfv_torchrl.env import NFVEnv
from nfv_torchrl.errors import ScenarioError, TrainingError, one_line
from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.scenario.streams import Stream, generator
from nfv_torchrl.settings.values import Count, Positive
from nfv_torchrl.state_checks import check_keys, check_list, check_tensor, check_whole
from nfv_torchrl.training.env_state import EnvState
from nfv_torchrl.training.workers import Answers, Part, WorkerCollector, unpack_worker

MakeEnv = Callable[[Sequence[Scenario], int], NFVEnv]
"""Makes an environment of scenarios and a batch size. Other processes get a copy of it."""
_RANDOM_STATE = len(torch.get_rng_state())


@dataclass
class World:
    """What is acted in: how environments are made, of which scenarios, and under which seed workers explore."""

    make_env: MakeEnv
    scenarios: Sequence[Scenario]
    seed: int


class Single:
    """All environments in this process: the reference, whose runs are resumed to the bit.

    Args:
        num_envs: environments, B.
        steps: of each in a batch, T.
        total_frames: of the whole training.
    """

    def __init__(self, num_envs: Count, steps: Count, total_frames: Count) -> None:
        self.num_envs, self.steps, self.total_frames = num_envs, steps, total_frames
        self.collector: BaseCollector | None = None
        self.failure: Exception | None = None

    def prepare(self, world: World) -> None:
        """Say what is acted in; comes before a state is loaded."""
        self._state = EnvState(world.make_env(world.scenarios, self.num_envs))

    def state_dict(self) -> dict[str, Any]:
        """The environments'."""
        return self._state.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from ``state_dict()``; comes before ``start``.

        Raises:
            CheckpointError: it belongs to other environments, or is damaged.
        """
        self._state.load_state_dict(state)

    def start(self, policy: TensorDictModuleBase, device: torch.device) -> Iterator[TensorDictBase]:
        """Begin to act by ``policy``, which is on ``device``; batches [B, T] on the CPU, until a worker fails."""
        self.collector = self._open(policy, device)
        return self._batches()

    def send_policy(self) -> None:
        """Give the policy as it is now to those who act by it; here they have it."""

    def shutdown(self) -> None:
        """End the processes.

        Raises:
            TrainingError: one of them had failed.
        """
        if self.collector is not None:
            try:
                self.collector.shutdown()
            except Exception:  # of a worker that is gone nothing can be ended
                if self.failure is None:
                    raise
        if self.failure is not None:
            raise TrainingError(
                f"collector: a worker failed at its work ({one_line(self.failure)}); all else is saved, go on with "
                "the same command and resume=true"
            ) from self.failure

    def _open(self, policy: TensorDictModuleBase, device: torch.device) -> BaseCollector:
        return Collector(
            self._state.env,
            policy,
            frames_per_batch=self.num_envs * self.steps,
            total_frames=-1,
            policy_device=device,
            env_device="cpu",
            storing_device="cpu",
            auto_register_policy_transforms=False,
            track_traj_ids=False,
        )

    def _batches(self) -> Iterator[TensorDictBase]:
        assert self.collector is not None
        yield from self.collector


class MultiSync(Single):
    """The environments in equal parts in several processes; a batch is complete when all have delivered.

    Environment b is in part ``b // (num_envs / workers)``, with the requests that it has in one process. Each process
    explores with random numbers of its own, which depend on the seed and on its number. So a run depends on the number
    of workers, and is the same each time. Environments and random numbers are asked of the workers for a checkpoint,
    and resumed to the bit.

    Args:
        num_envs: environments, B, a multiple of ``workers``.
        steps: of each in a batch, T.
        total_frames: of the whole training.
        workers: processes.

    Raises:
        ScenarioError: the environments cannot be shared out equally.
    """

    exact = True

    def __init__(self, num_envs: Count, steps: Count, total_frames: Count, workers: Count = 2) -> None:
        super().__init__(num_envs, steps, total_frames)
        if num_envs % workers:
            raise ScenarioError(
                f"collector.workers: {workers} cannot share {num_envs} environments equally; use a divisor of "
                "collector.num_envs"
            )
        self.workers = workers
        self._starts = 0  # how often environments began anew; so that they never repeat their requests
        self._loaded: list[dict[str, Any]] = []

    def prepare(self, world: World) -> None:
        """See ``Single``."""
        self._world = World(_portable(world.make_env), world.scenarios, world.seed)

    def state_dict(self) -> dict[str, Any]:
        """Of each worker its environments and random numbers; none where these cannot be had."""
        return {"starts": self._starts, "parts": self._ask() if self.exact and self.failure is None else []}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See ``Single``. Without the workers' states their environments begin anew, and that is said."""
        check_keys("env", state, ("starts", "parts"))
        self._starts = check_whole("env.starts", state["starts"], 0, 2**31)
        if not state["parts"]:
            self._starts += 1
            print("The environments begin anew, with other requests: the checkpoint does not hold where they were.")
            return
        self._loaded = check_list("env.parts", state["parts"], self.workers)
        for number, part in enumerate(self._loaded):
            check_keys(f"env.parts.{number}", part, ("env", "random"))
            check_tensor(f"env.parts.{number}.random", part["random"], torch.uint8, (_RANDOM_STATE,))
            env = Part(self._world.make_env, *self._share(number), part["random"], None)()
            EnvState(env).load_state_dict(part["env"])  # here, where a refusal is one clear error

    def send_policy(self) -> None:
        """See ``Single``; epsilon is one of the policy's numbers."""
        assert self.collector is not None
        if self.failure is None:
            try:
                self._send()
            except Exception as error:  # whatever the end of a process turns into
                self.failure = error

    def _send(self) -> None:
        assert self.collector is not None
        self.collector.update_policy_weights_()

    def _share(self, number: int) -> tuple[list[Scenario], int, int]:
        """Scenarios and number of environments of a worker, and the number of its first."""
        size = self.num_envs // self.workers
        first = self._starts * self.num_envs + number * size
        scenarios, turn = [*self._world.scenarios], first % len(self._world.scenarios)
        return scenarios[turn:] + scenarios[:turn], size, first

    def _parts(self) -> list[Part]:
        """What each worker begins with."""
        if self._loaded:
            return [
                Part(self._world.make_env, *self._share(number), part["random"], part["env"])
                for number, part in enumerate(self._loaded)
            ]
        parts = []
        for number in range(self.workers):
            drawn = generator(self._world.seed, Stream.EXPLORATION, self._starts, number).integers(2**62)
            random = torch.Generator().manual_seed(int(np.int64(drawn))).get_state()
            parts.append(Part(self._world.make_env, *self._share(number), random, None))
        return parts

    def _ask(self) -> list[dict[str, Any]]:
        if self.collector is None:
            return []
        try:
            states: Any = self.collector.state_dict()
        except Exception as error:  # lost since the last batch
            self.failure = error
            return []
        return [unpack_worker(states[key]) for key in self._keys()]

    def _keys(self) -> Sequence[Any]:
        """Where the state of each worker is in that of the collector."""
        return [f"worker{number}" for number in range(self.workers)]

    def _open(self, policy: TensorDictModuleBase, device: torch.device) -> BaseCollector:
        return self._workers(MultiSyncCollector, policy, device, self.num_envs * self.steps, cat_results=0)

    def _workers(
        self, kind: type[BaseCollector], policy: TensorDictModuleBase, device: torch.device, frames: int, **more: Any
    ) -> BaseCollector:
        collector: Any = kind(
            self._parts(),
            policy,
            frames_per_batch=frames,
            total_frames=-1,
            policy_device=device,
            env_device="cpu",
            storing_device="cpu",
            use_buffers=True,
            collector_class=WorkerCollector,
            num_threads=torch.get_num_threads(),
            auto_register_policy_transforms=False,
            **more,
        )
        for scheme in collector._weight_sync_schemes.values():
            for number, queue in scheme._ack_queues.items():
                scheme._ack_queues[number] = Answers(queue, collector.procs[number])
        return collector

    def _batches(self) -> Iterator[TensorDictBase]:
        assert self.collector is not None
        deliveries = iter(self.collector)
        while self.failure is None:
            try:
                batch = next(deliveries)
            except Exception as error:
                self.failure = self._what_ended(error)
            else:
                yield self._whole(batch)

    def _what_ended(self, error: Exception) -> Exception:
        """The process that is gone, if it is known; TorchRL may fail at ending the others before it names it."""
        for number, process in enumerate(getattr(self.collector, "procs", ())):
            with contextlib.suppress(ValueError):  # closed by TorchRL, which ends the others by SIGTERM
                if process.exitcode not in (None, 0, -signal.SIGTERM):
                    return RuntimeError(f"worker {number} ended with exit code {process.exitcode}")
        return error

    def _whole(self, batch: TensorDictBase) -> TensorDictBase:
        return batch


class MultiAsync(MultiSync):
    """As ``MultiSync``, but the workers go on acting while the learner learns.

    A batch is the next ``workers`` deliveries, in the order in which they come; a fast worker may be in it twice. They
    were acted by weights of up to two batches ago. So no two runs are the same. Environments are never at rest, hence
    not in a checkpoint: a resumed run has its weights, memory and totals, and its environments begin anew, with other
    requests.

    Args:
        num_envs: environments, B, a multiple of ``workers``.
        steps: of each in a batch, T.
        total_frames: of the whole training.
        workers: processes.
    """

    exact = False

    def _open(self, policy: TensorDictModuleBase, device: torch.device) -> BaseCollector:
        return self._workers(MultiAsyncCollector, policy, device, self.num_envs * self.steps // self.workers)

    def _batches(self) -> Iterator[TensorDictBase]:
        deliveries = super()._batches()
        while True:
            batch = [delivery for _, delivery in zip(range(self.workers), deliveries, strict=False)]
            if len(batch) < self.workers:
                return
            yield torch.cat(batch)


class Ray(MultiSync):
    """As ``MultiSync``, with workers anywhere on a Ray cluster.

    The machines of the cluster need this package, in the same version. A worker that is lost ends the run after all
    else has been saved.

    Args:
        num_envs: environments, B, a multiple of ``workers``.
        steps: of each in a batch, T.
        total_frames: of the whole training.
        workers: actors on the cluster.
        address: of a running cluster, such as ``10.0.0.1:6379``, or ``auto`` for the one that this machine is in; None
            starts one on this machine for the run.
        cpus: cores that each worker takes of the cluster.

    Raises:
        ScenarioError: Ray is not installed.
    """

    def __init__(
        self,
        num_envs: Count,
        steps: Count,
        total_frames: Count,
        workers: Count = 2,
        address: str | None = None,
        cpus: Positive = 1.0,
    ) -> None:
        super().__init__(num_envs, steps, total_frames, workers)
        self.address, self.cpus = address, cpus
        try:
            import ray
        except ImportError as error:
            raise ScenarioError(
                "collector: ray is not installed; install it by pip install -c constraints.txt -e .[ray], or use "
                "collector=multi_sync"
            ) from error
        self._ray = ray

    def _connect(self) -> None:
        """Reach the cluster, and see that it has the cores."""
        needed = self.workers * self.cpus
        local = {"address": "local", "num_cpus": int(np.ceil(needed)), "include_dashboard": False}
        try:
            self._ray.init(
                **({"address": self.address} if self.address else local),
                log_to_driver=False,
                logging_level=logging.WARNING,
            )
        except Exception as error:  # a ConnectionError, or what its clients raise
            raise ScenarioError(
                f"collector.address: no Ray cluster answers at {self.address} ({one_line(error)}); start one by ray "
                "start --head, or leave it null"
            ) from error
        cores = self._ray.cluster_resources().get("CPU", 0)
        if cores < needed:
            self._ray.shutdown()
            raise ScenarioError(
                f"collector.workers: {self.workers} need {needed:g} cores, and the cluster has {cores:g}; use "
                "fewer, or a smaller collector.cpus"
            )

    def _open(self, policy: TensorDictModuleBase, device: torch.device) -> BaseCollector:
        from torchrl.collectors.distributed import RayCollector

        self._connect()
        self._policy = policy
        collector = RayCollector(
            self._parts(),
            copy.deepcopy(policy).to("cpu"),  # a worker may have no GPU
            frames_per_batch=self.num_envs * self.steps,
            total_frames=2**62,  # of -1 this class would collect nothing
            policy_device="cpu",
            env_device="cpu",
            storing_device="cpu",
            collector_class=WorkerCollector,
            collector_kwargs={"auto_register_policy_transforms": False},
            remote_configs={"num_cpus": self.cpus},
            sync=True,
            weight_sync_schemes={},  # Ray itself carries weights, see ``_send``
        )
        collector._weight_sync_initialized = True
        return collector

    def _send(self) -> None:
        """Put one copy of the weights in Ray's object store, for all workers.

        TorchRL's own way opens a ``torch.distributed`` group beside Ray: further ports between the machines, and 60 s
        for all to join.
        """
        weights = {key: value.to("cpu") for key, value in self._policy.state_dict().items()}
        place, workers = self._ray.put(weights), cast(Any, self.collector).remote_collectors
        self._ray.get([worker.receive_policy.remote(place) for worker in workers])

    def _keys(self) -> Sequence[Any]:
        return range(self.workers)

    def _whole(self, batch: TensorDictBase) -> TensorDictBase:
        return batch.flatten(0, 1)

    def shutdown(self) -> None:
        """See ``Single``; the cluster stays if it was there before."""
        try:
            super().shutdown()
        finally:
            self._ray.shutdown()


def _portable(make_env: Any) -> Any:
    """``make_env`` as it can travel: a loss among its arguments is copied to the CPU, which every worker has."""
    if not isinstance(make_env, partial) or not isinstance(make_env.keywords.get("loss"), nn.Module):
        return make_env
    loss = copy.deepcopy(make_env.keywords["loss"]).to("cpu").requires_grad_(False)
    return partial(make_env.func, *make_env.args, **{**make_env.keywords, "loss": loss})
