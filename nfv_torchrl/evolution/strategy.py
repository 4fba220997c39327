"""CMA-ES of the ``cma`` package, with an exact resume that needs no pickle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cma
import numpy as np

from nfv_torchrl.errors import CheckpointError
from nfv_torchrl.scenario.streams import Stream, generator


class Strategy:
    """Covariance matrix adaptation (Hansen, "The CMA evolution strategy: a tutorial", 2016), maximising.

    All that a generation depends on is the seed and the fitness of the generations before, so that is what a state
    dict keeps; loading one asks and tells all of them again, which takes moments.

    Args:
        start: float [P], where the search begins.
        sigma: initial standard deviation of every parameter.
        population: candidates of a generation; None: the default 4 + 3 log(P).
        diagonal: adapt variances only, for more parameters than a covariance matrix has room for.
        seed: of the candidates drawn.
    """

    def __init__(
        self,
        start: np.ndarray,
        *,
        sigma: float = 0.3,
        population: int | None = None,
        diagonal: bool = False,
        seed: int = 0,
    ) -> None:
        self._start = np.asarray(start, np.float64)
        options: dict[str, Any] = {"verbose": -9, "CMA_diagonal": diagonal, "seed": np.nan}
        if population is not None:
            options["popsize"] = population
        rng = generator(seed, Stream.EVOLUTION)
        options["randn"] = lambda *shape: rng.standard_normal(shape)
        self._search = cma.CMAEvolutionStrategy(self._start, sigma, options)
        self._fitness: list[list[float]] = []

    @property
    def generation(self) -> int:
        """Number of finished generations."""
        return len(self._fitness)

    @property
    def population(self) -> int:
        """Candidates of a generation."""
        return int(self._search.popsize)

    @property
    def mean(self) -> np.ndarray:
        """Centre of the search, float64 [P]: its best answer so far."""
        return self._search.mean.copy()

    @property
    def sigma(self) -> float:
        """Overall step size."""
        return float(self._search.sigma)

    def ask(self) -> list[np.ndarray]:
        """The next candidates, float64 [P] each."""
        self._asked = self._search.ask()
        return self._asked

    def tell(self, fitness: Sequence[float]) -> None:
        """The fitness of the candidates asked for, higher is better."""
        self._search.tell(self._asked, [-value for value in fitness])
        self._fitness.append([float(value) for value in fitness])

    def state_dict(self) -> dict[str, Any]:
        """The fitness of every generation."""
        return {"fitness": [list(values) for values in self._fitness]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go through the generations of ``state_dict()`` again; for a new strategy of the same arguments.

        Raises:
            CheckpointError: not the finite fitness of a whole population in every generation.
        """
        for number, values in enumerate(state["fitness"]):
            if len(values) != self.population or not np.isfinite(np.asarray(values, np.float64)).all():
                raise CheckpointError(f"generation {number} is not {self.population} finite numbers")
            self.ask()
            self.tell(values)
