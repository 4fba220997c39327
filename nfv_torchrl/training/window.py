"""Running totals of what happened since the last log line."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from nfv_torchrl.simulator import REASON_NAMES
from nfv_torchrl.vocabulary import TABLE

_OF_REQUESTS = ("accepted", "request_cost", "request_delay", "request_hops")
_OF_SLOTS = ("slots_closed", "slot_cost", "slot_vm_use", "slot_link_use")
_READ = (*_OF_REQUESTS, *_OF_SLOTS, "interrupted", "service", "reason", "request_slot")


class TrainingWindow:
    """Sums over collected batches; ``metrics`` turns them into the numbers of a log line.

    Args:
        services: names of the service types.
        warmup: requests that arrive in slots before this one do not count.
    """

    def __init__(self, services: tuple[str, ...], warmup: int = 0) -> None:
        self.services = services
        self.warmup = warmup
        self.reset()

    def reset(self) -> None:
        """Start again from zero."""
        kinds = len(self.services)
        self.sums = torch.zeros(len(_OF_REQUESTS + _OF_SLOTS), dtype=torch.float64)
        self.interrupted = torch.zeros((), dtype=torch.float64)
        self.arrived = torch.zeros(kinds, dtype=torch.float64)
        self.accepted = torch.zeros(kinds, dtype=torch.float64)
        self.reasons = torch.zeros(len(REASON_NAMES), dtype=torch.float64)

    def add(self, data: TensorDictBase) -> None:
        """Take in a collected batch; reads ``request_done`` and ``outcome`` under ``next``, [..., 1] each."""
        after, outcome = data.get("next"), data.get(("next", "outcome"))
        rows = torch.cat([outcome.get(name) for name in _READ], -1).flatten(0, -2).to(torch.float64)
        step = dict(zip(_READ, rows.unbind(-1), strict=True))
        # Slot sums leave out the warm-up already; requests that arrived in it are dropped here.
        counted = rows[after.get("request_done").flatten() & (step["request_slot"] >= self.warmup)]
        ended = dict(zip(_READ, counted.unbind(-1), strict=True))
        sources = [ended[name] for name in _OF_REQUESTS] + [step[name] for name in _OF_SLOTS]
        for place, source in enumerate(sources):
            self.sums[place] += source.sum()
        self.interrupted += step["interrupted"].sum()
        service, taken = ended["service"].long(), ended["accepted"] > 0
        kinds = len(self.services)
        self.arrived += service.bincount(minlength=kinds)
        self.accepted += service[taken].bincount(minlength=kinds)
        self.reasons += ended["reason"][~taken].long().bincount(minlength=len(REASON_NAMES))

    def metrics(self) -> dict[str, float]:
        """The ratios that the table of all quantities names, by TensorBoard tag; what has no data yet is left out."""
        values: dict[str, float] = {}
        for row in TABLE.values():
            if row.train is not None:
                above, below = row.train
                for part, totals in self._totals(row.part).items():
                    if totals[below]:
                        values[f"train/{row.key(part)}"] = totals[above] / totals[below]
        return values

    def _totals(self, parts: str) -> dict[str, dict[str, float]]:
        """The totals whose ratios the table names, by part: of every SERVICE or REASON, or of all requests ("")."""
        whole = dict(zip((*_OF_REQUESTS, *_OF_SLOTS), self.sums.tolist(), strict=True))
        whole |= {"arrived": float(self.arrived.sum()), "interrupted": float(self.interrupted)}
        if parts == "SERVICE":
            counts = zip(self.services, self.arrived.tolist(), self.accepted.tolist(), strict=True)
            return {name: {"arrived": came, "accepted": taken} for name, came, taken in counts}
        if parts == "REASON":
            refused = zip(REASON_NAMES, self.reasons.tolist(), strict=True)
            return {name: whole | {"rejected": count} for name, count in refused}
        return {"": whole}

    def state_dict(self) -> dict[str, Tensor]:
        """The sums."""
        names = ("sums", "interrupted", "arrived", "accepted", "reasons")
        return {name: getattr(self, name).clone() for name in names}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from ``state_dict()``."""
        for name, value in state.items():
            setattr(self, name, value.clone())
