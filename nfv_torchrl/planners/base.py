"""What every planner offers to the code that runs it."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from nfv_torchrl.planners.walks import OVERFLOW
from nfv_torchrl.simulator.tables import Rules, Tables


class Planner(Protocol):
    """Answers one request with a whole embedding, or refuses it.

    ``prepare`` is called once with the tables and rules of the simulator, before the first plan. A planner is used by
    one thread at a time: it owns scratch arrays.
    """

    def prepare(self, tables: Tables, rules: Rules) -> None:
        """Allocate what plans on these tables need."""

    def plan(
        self,
        tables: Tables,
        rules: Rules,
        net: int,
        vm_offered: np.ndarray,
        link_offered: np.ndarray,
        service: int,
        ingress: int,
        egress: int,
        plan_out: np.ndarray,
    ) -> int:
        """Plan one request.

        Args:
            tables: the tables given to ``prepare``.
            rules: the rules given to ``prepare``.
            net: row of the tables.
            vm_offered: ledger units (cycles/s) available now, int64 [N, V].
            link_offered: ledger units (bit/s) available now, int64 [L].
            service: row of the catalogue.
            ingress: first node.
            egress: last node.
            plan_out: receives the actions 2 * (node * V + vm) + placed, int64 [max_steps].

        Returns:
            Number of actions, 0 if the planner has no embedding for the request.
        """

    def plan_batch(
        self,
        tables: Tables,
        rules: Rules,
        rows: np.ndarray,
        env_net: np.ndarray,
        vm_offered: np.ndarray,
        link_offered: np.ndarray,
        service: np.ndarray,
        ingress: np.ndarray,
        egress: np.ndarray,
        plans: np.ndarray,
        lengths: np.ndarray,
    ) -> None:
        """Plan the requests of many environments in one compiled loop.

        Args:
            tables: the tables given to ``prepare``.
            rules: the rules given to ``prepare``.
            rows: environments to answer, int64 [R].
            env_net: row of the tables of each environment, int64 [B].
            vm_offered: int64 [B, N, V].
            link_offered: int64 [B, L].
            service: int64 [B].
            ingress: int64 [B].
            egress: int64 [B].
            plans: receives the actions, int64 [B, max_steps].
            lengths: receives the number of actions, 0 where there is no embedding, int64 [B]; other rows stay.
        """


class CompiledPlanner:
    """A planner whose kernels work in scratch arrays that grow when a kernel asks for it.

    Subclasses give ``_make``, ``_grow``, ``_kernel`` (one request) and ``_batch`` (a loop over rows that returns how
    many rows it answered before its scratch was too small).
    """

    def __init__(self) -> None:
        self._scratch: Any = None

    def prepare(self, tables: Tables, rules: Rules) -> None:
        """Allocate what plans on these tables need."""
        self._scratch = self._make(tables, rules)

    def plan(
        self,
        tables: Tables,
        rules: Rules,
        net: int,
        vm_offered: np.ndarray,
        link_offered: np.ndarray,
        service: int,
        ingress: int,
        egress: int,
        plan_out: np.ndarray,
    ) -> int:
        """Plan one request; see ``Planner.plan``."""
        if self._scratch is None:
            self.prepare(tables, rules)
        while True:
            steps = self._kernel(tables, rules, net, vm_offered, link_offered, service, ingress, egress, plan_out)
            if steps != OVERFLOW:
                return int(steps)
            self._scratch = self._grow(tables)

    def plan_batch(
        self,
        tables: Tables,
        rules: Rules,
        rows: np.ndarray,
        env_net: np.ndarray,
        vm_offered: np.ndarray,
        link_offered: np.ndarray,
        service: np.ndarray,
        ingress: np.ndarray,
        egress: np.ndarray,
        plans: np.ndarray,
        lengths: np.ndarray,
    ) -> None:
        """Plan the requests of many environments; see ``Planner.plan_batch``."""
        if self._scratch is None:
            self.prepare(tables, rules)
        while True:
            done = self._batch(
                tables, rules, rows, env_net, vm_offered, link_offered, service, ingress, egress, plans, lengths
            )
            if done == rows.size:
                return
            rows = rows[done:]
            self._scratch = self._grow(tables)

    def _make(self, tables: Tables, rules: Rules) -> Any:
        raise NotImplementedError

    def _grow(self, tables: Tables) -> Any:
        raise NotImplementedError

    def _kernel(self, *request: Any) -> int:
        raise NotImplementedError

    def _batch(self, *requests: Any) -> int:
        raise NotImplementedError
