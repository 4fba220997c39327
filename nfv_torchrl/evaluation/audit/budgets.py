"""How many steps a request may take: J of its own, or what its service has left of J in the slot."""

from __future__ import annotations

from typing import Any

from nfv_torchrl.evaluation.audit.files import FREE, Request, RunFiles


class Steps:
    """Counts the steps of each service in the slot at hand. Requests are told of in the order of their arrival."""

    def __init__(self, files: RunFiles) -> None:
        self.most, self.shared = files.scenario["max_steps"], files.steps_are_shared
        names = list(files.services)
        pairs = files.scenario.get("endpoint_pairs")
        self.by_pair = pairs is not None
        # The services of the paper: a type with one of its pairs of endpoints, in order.
        self.order = [
            (name, *pair) for name, mine in zip(names, pairs or [[[]] for _ in names], strict=True) for pair in mine
        ]
        self.slot = -1
        self.spent: dict[tuple[Any, ...], int] = {}

    def left(self, request: Request) -> int:
        """Steps that the walk of ``request`` may take in all."""
        if not self.shared:
            return self.most
        spent = self.spent.get(self._service(request), 0) if request.slot == self.slot else 0
        return self.most - spent

    def count(self, request: Request, decision: dict[str, Any]) -> None:
        """Note what ``request`` took: the steps of its walk, or those that passed before it was rejected."""
        if not self.shared:
            return
        if request.slot != self.slot:
            self.slot, self.spent = request.slot, {}
        taken = decision.get("steps") if decision.get("accepted") is True else (decision.get("tried") or [])[:-1]
        service = self._service(request)
        self.spent[service] = self.spent.get(service, 0) + (len(taken) if isinstance(taken, list) else 0)

    def _service(self, request: Request) -> tuple[Any, ...]:
        """What the observation tells as one: with a free end the first of its type, on no pair of the catalogue the
        last of all."""
        if not self.by_pair:
            return (request.service,)
        if FREE in (request.ingress, request.egress):
            return next(service for service in self.order if service[0] == request.service)
        service = (request.service, request.ingress, request.egress)
        return service if service in self.order else self.order[-1]
