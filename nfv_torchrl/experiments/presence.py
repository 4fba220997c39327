"""How long users stay: the share still present against the time since they came."""

from __future__ import annotations

import math

from nfv_torchrl.evaluation.figures import tidy_row
from nfv_torchrl.evaluation.statistics import Interval, mean_interval
from nfv_torchrl.experiments.cells import Cell, CellStore
from nfv_torchrl.experiments.drawing import Drawn, panel_figure
from nfv_torchrl.experiments.rows import Rows
from nfv_torchrl.experiments.study import Study

LAST = 3600
STEP = 180


class PresenceProbability:
    """Theory exp(-t / mu), and the workloads: one mu, one panel."""

    def cells(self, study: Study) -> list[Cell]:
        return [self._cell(study, lifetime) for lifetime in study.budget["mean_lifetimes"]]

    def draw(self, study: Study, store: CellStore) -> Drawn:
        rows: Rows = []
        for lifetime in study.budget["mean_lifetimes"]:
            cell = self._cell(study, lifetime)
            shares = store.read(cell)["shares"].values()
            panel = f"μ = {lifetime:g} s"
            for place, slot in enumerate(self._slots()):
                expected = math.exp(-slot / lifetime)
                rows.append(tidy_row("exp(-t/μ)", slot, Interval(expected, math.nan, math.nan, 0), panel=panel))
                seen = mean_interval([share[place] for share in shares])
                rows.append(tidy_row("workloads", slot, seen, panel=panel, cell=cell.key))
        figure = panel_figure(
            rows,
            title="Users still present (1/e = 37 % after t = μ)",
            caption=study.about(agents=()),
            x_label="time since arrival t (s)",
            y_label="share of users still present",
            like={"exp(-t/μ)": "exp(-t/μ)"},
        )
        return Drawn(figure, rows)

    def _cell(self, study: Study, lifetime: float) -> Cell:
        return study.presence(study.world(mean_lifetime=lifetime), self._slots())

    def _slots(self) -> list[int]:
        return list(range(0, LAST + 1, STEP))
