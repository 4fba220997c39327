"""Rows for each valid action that know what is offered now: whether and how the request can be finished after the step.

Costs are over the least cost that the request had when it came. So a tenth more is a tenth more for every service, and
what all ways have in common cancels out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torchrl.data import Binary, Categorical, Composite, Unbounded

from nfv_torchrl.columns import columns
from nfv_torchrl.observations.ahead import (
    CHEAP,
    SPARE,
    Looking,
    delay_of,
    next_action,
    price_of,
    step_of,
)
from nfv_torchrl.observations.base import gather
from nfv_torchrl.observations.candidates import candidate_rows, count_features, write_row
from nfv_torchrl.observations.costs_to_go import costs_to_go
from nfv_torchrl.observations.menu import AT_ONCE
from nfv_torchrl.observations.standing import MOST, STATE, scale_of, state_scales, write_state
from nfv_torchrl.planners.menu import STEEPNESS
from nfv_torchrl.settings.values import AboveOne, NotNegative, Share
from nfv_torchrl.simulator import Simulator
from nfv_torchrl.simulator.compiled import kernel, part
from nfv_torchrl.simulator.tables import DELAY_TOLERANCE, Rules, Tables

PRICE = 64.0
"""p of the raised prices in mean unit costs of VMs: that of ``priced``."""


class LookaheadFeatures(NamedTuple):
    """Columns of a row. A way is what is done with the rest of the request, a cost that of its whole walk.

    Once a walk has left the cheapest plan for the one at raised prices, that one is all there is: it counts as both.
    """

    reject: int  # 1 for the row of the reject action
    fits: int  # 1: the request can be finished after the step, as far as is known
    planned: int  # 1: the cheapest walk goes this way
    spared: int  # 1: the walk that is cheapest at raised prices goes this way
    step_cost: int  # of the step alone
    cost: int  # of the cheapest way after the step
    regret: int  # that less the same of the best row
    priced: int  # what that way costs at raised prices
    priced_regret: int  # that less the least of all rows
    spare_cost: int  # of the way after the step that costs least at raised prices
    spare_regret: int  # what that way costs at raised prices, less the least of all rows
    delay: int  # least delay of the whole walk after the step, over the tolerable delay


ROW = columns(LookaheadFeatures)
FEATURES = LookaheadFeatures._fields


class Rows(NamedTuple):
    """What the observation shows, for B environments."""

    features: np.ndarray  # float32 [B, C, F]
    action: np.ndarray  # int64 [B, C]
    mask: np.ndarray  # bool [B, C]
    state: np.ndarray  # float32 [B, S]


@part
def write_ahead(world, b, own, action, row):
    """Columns of one valid action into ``row``, which holds zeros; regrets come later, by ``write_regrets``."""
    kept, e = own.kept, world.env[b]
    if action == world.seen.mask.shape[1] - 1:
        row[ROW.reject] = 1.0
        return
    step = step_of(world, b, kept, action)
    placed, at = kept.placed[b] + step.places, kept.steps[b]
    least, step_cost = scale_of(kept, b), price_of(world, b, own, step, CHEAP)
    delay = kept.elapsed[b] + delay_of(world, b, kept, step) + kept.delay[b, placed, step.node]
    tolerable = world.tables.tolerable_delay[e.profile]
    row[ROW.step_cost] = min(step_cost / least, MOST)
    row[ROW.delay] = min(delay / tolerable, MOST)
    cost = kept.spent[b, CHEAP] + step_cost + kept.value[b, CHEAP, placed, step.node]
    priced = kept.spent[b, SPARE] + price_of(world, b, own, step, SPARE) + kept.value[b, SPARE, placed, step.node]
    row[ROW.fits] = cost < np.inf and delay <= tolerable + DELAY_TOLERANCE
    if not own.exact:
        _write_ways(row, least, (cost, priced), (cost, priced))
        return
    row[ROW.fits] = row[ROW.fits] * (kept.length[b, CHEAP] > 0)
    planned, spared = next_action(kept, b, CHEAP, at) == action, next_action(kept, b, SPARE, at) == action
    row[ROW.planned], row[ROW.spared] = planned, spared
    if planned or spared:
        one, other = (CHEAP if planned else SPARE), (SPARE if spared else CHEAP)
        total = kept.total[b]
        _write_ways(row, least, (total[one, CHEAP], total[one, SPARE]), (total[other, CHEAP], total[other, SPARE]))
    else:  # no way is cheaper than the plan; what is off both plans is taken to use as much of what is scarce, too
        ways = max(cost, kept.total[b, CHEAP, CHEAP]), max(priced, kept.total[b, CHEAP, SPARE])
        _write_ways(row, least, ways, ways)


@part
def _write_ways(row, least, cheap, spare):
    """Costs of the two ways after a step, each (cost, cost at raised prices) in $."""
    row[ROW.cost], row[ROW.priced] = min(cheap[0] / least, MOST), min(cheap[1] / least, MOST * MOST)
    row[ROW.spare_cost], row[ROW.spare_regret] = min(spare[0] / least, MOST), min(spare[1] / least, MOST * MOST)


@part
def write_regrets(rows, count):
    """Fill in what the first ``count`` rows have above the best that fits."""
    cost, priced = np.inf, np.inf
    for k in range(count):
        if rows[k, ROW.fits] > 0.0:
            cost = min(cost, rows[k, ROW.cost])
            priced = min(priced, rows[k, ROW.priced], rows[k, ROW.spare_regret])
    for k in range(count):
        if rows[k, ROW.fits] > 0.0:
            rows[k, ROW.regret] = rows[k, ROW.cost] - cost
            rows[k, ROW.priced_regret] = min(rows[k, ROW.priced] - priced, MOST)
            rows[k, ROW.spare_regret] = min(rows[k, ROW.spare_regret] - priced, MOST)


@part
def fill_rows(world, b, own, scales, rows, state):
    """Rows of environment b float32 [C, features] and its state float32 [S], which hold zeros, by what is known.

    Returns:
        Number of rows.
    """
    e = world.env[b]
    if e.done == 0:
        for k in range(e.mask_count):
            write_ahead(world, b, own, np.int64(world.seen.valid[b, k]), rows[k])
        write_regrets(rows, e.mask_count)
        write_state(world, b, own, scales, state)
    return e.mask_count


@kernel
def write_lookahead(world, own, scales, shown):
    """Fill ``shown``, the ``Rows`` of all environments, by what ``Ahead`` knows of them."""
    reject = world.seen.mask.shape[1] - 1
    for b in range(shown.action.shape[0]):
        for k in range(shown.action.shape[1]):
            for column in range(shown.features.shape[2]):
                shown.features[b, k, column] = 0.0
        for column in range(shown.state.shape[1]):
            shown.state[b, column] = 0.0
        count = fill_rows(world, b, own, scales, shown.features[b], shown.state[b])
        for k in range(shown.action.shape[1]):
            shown.action[b, k] = np.int64(world.seen.valid[b, k]) if k < count else np.int64(reject)
            shown.mask[b, k] = k < count


@kernel
def add_candidates(world, costs, features):
    """The columns of ``candidates`` after those of look-ahead, into the rows in use of ``features`` [B, C, F + F']."""
    for b in range(features.shape[0]):
        for k in range(world.env[b].mask_count):
            write_row(world, b, costs, np.int64(world.seen.valid[b, k]), features[b, k, len(FEATURES) :])


class LookaheadObservation:
    """Key ``lookahead``, nested: a row for each valid action, in no particular order, then padding, and a state.

    ``features`` float32 [B, C, F] (columns of ``LookaheadFeatures``), ``action`` int64 [B, C]: the action a row stands
    for (``reject`` in padding), ``mask`` bool [B, C]: rows in use, ``state`` float32 [B, S] (``StateFeatures``). C is
    that of ``CandidateObservation``.

    Args:
        exact: search the cheapest walk exactly, at unit costs and at raised prices. Then ``planned`` and ``spared``
            rows have the true cost of their ways, ``fits`` is exact for the best row, and other rows cost no less than
            the best. False: all costs are lower bounds, with exact packing at the egress alone.
        price: p of the raised prices, in mean unit costs of the network's VMs; see ``PricedPlanner``.
        steepness: M, how late they rise.
        candidates: rows go on with the columns of ``CandidateFeatures`` and the service type one-hot.
        at_once: where lifetimes are seen, share of the price of a mean stay that is paid for coming, however short the
            stay is; the rest is in proportion to it.

    Raises:
        ScenarioError: on reading, functions of a request must not share nodes (``placement: distinct``).
    """

    def __init__(
        self,
        *,
        exact: bool = True,
        price: NotNegative = PRICE,
        steepness: AboveOne = STEEPNESS,
        candidates: bool = False,
        at_once: Share = AT_ONCE,
    ) -> None:
        self.candidates, self._at_once = candidates, at_once
        self._looking = Looking(exact=exact, price=price, steepness=steepness)
        self._tables: Tables | None = None

    def _prepare(self, tables: Tables, rules: Rules) -> None:
        if self._tables is not tables:
            self._tables, self._scales = tables, state_scales(tables, self._at_once)
            self._costs = costs_to_go(tables, rules) if self.candidates else None

    def shape(self, tables: Tables, rules: Rules) -> tuple[int, int]:
        """Rows C and columns F."""
        more = count_features(tables.services, request=False) if self.candidates else 0
        return candidate_rows(tables, rules), len(FEATURES) + more

    def specs(self, simulator: Simulator) -> dict:
        """See ``ObservationPart``."""
        batch = torch.Size([simulator.batch_size])
        rows, features = self.shape(simulator.tables, simulator.world.rules)
        return {
            "lookahead": Composite(
                features=Unbounded((*batch, rows, features), dtype=torch.float32),
                action=Categorical(simulator.num_actions, shape=(*batch, rows), dtype=torch.int64),
                mask=Binary(rows, shape=(*batch, rows), dtype=torch.bool),
                state=Unbounded((*batch, len(STATE)), dtype=torch.float32),
                shape=batch,
            )
        }

    def read(self, simulator: Simulator) -> dict:
        """See ``ObservationPart``."""
        world = simulator.world
        self._prepare(world.tables, world.rules)
        rows, features = self.shape(world.tables, world.rules)
        batch = simulator.batch_size
        values = {
            "features": torch.empty(batch, rows, features),
            "action": torch.empty(batch, rows, dtype=torch.int64),
            "mask": torch.empty(batch, rows, dtype=torch.bool),
            "state": torch.empty(batch, len(STATE)),
        }
        shown = Rows(*(values[name].numpy() for name in Rows._fields))
        write_lookahead(world, self._looking.look(world), self._scales, shown)
        if self._costs is not None:
            add_candidates(world, self._costs, shown.features)
        return {"lookahead": gather(values, batch)}

    def known(self) -> Mapping[str, np.ndarray]:
        """What rewards may use beside the outcome: ``least_cost`` ($) of the request at the last ``read``, float64
        [B]."""
        return {"least_cost": self._looking.ahead.kept.least}
