"""Results as pandas data frames. Needs pandas, which is not installed with the package."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.comparison import Comparison
from nfv_torchrl.evaluation.records import RunRecord
from nfv_torchrl.simulator.reasons import REASON_NAMES

if TYPE_CHECKING:
    import pandas as pd


def requests_frame(record: RunRecord) -> pd.DataFrame:
    """One row a request, in arrival order.

    Columns: ``slot``, ``service`` (name), ``ingress``, ``egress`` (labels), ``lifetime_s``, ``accepted``, ``reason``
    (of a rejection, else missing), ``delay_ms``, ``cost`` ($), ``hops`` (missing where rejected) and
    ``interrupted_at`` (slot of the failure that ended it, else missing).

    Raises:
        ScenarioError: pandas is not installed.
    """
    frames = _pandas()
    workload, scenario = record.workload, record.scenario
    names = np.array([kind.name for kind in scenario.catalogue.types], object)
    labels = np.array([*scenario.substrate.labels, "any"], object)  # a free end is -1
    accepted = record.accepted
    reasons = np.where(accepted, None, np.array(REASON_NAMES, object)[record.reason])
    frame = frames.DataFrame(
        {
            "slot": workload.slot,
            "service": names[workload.service],
            "ingress": labels[workload.ingress],
            "egress": labels[workload.egress],
            "lifetime_s": workload.lifetime,
            "accepted": accepted,
            "reason": reasons,
            "delay_ms": record.delay_ms,
            "cost": record.cost,
            "hops": frames.array(np.where(accepted, record.hops, 0), dtype="Int64"),
            "interrupted_at": frames.array(np.maximum(record.interrupted_at, 0), dtype="Int64"),
        }
    )
    frame.loc[~accepted, "hops"] = frames.NA
    frame.loc[record.interrupted_at < 0, "interrupted_at"] = frames.NA
    return frame


def metrics_frame(comparison: Comparison) -> pd.DataFrame:
    """One row for each method and seed (index ``method``, ``seed``), one column for each metric.

    Upper bounds on AAR are rows of methods called ``bound: NAME``.

    Raises:
        ScenarioError: pandas is not installed.
    """
    frames = _pandas()
    rows = {(method, seed): run for method, runs in comparison.metrics.items() for seed, run in runs.items()}
    rows |= {
        (f"bound: {name}", seed): {"aar": aar} for name, of in comparison.bounds.items() for seed, aar in of.items()
    }
    index = frames.MultiIndex.from_tuples(list(rows), names=["method", "seed"])
    return frames.DataFrame(list(rows.values()), index=index)


def _pandas():
    try:
        import pandas
    except ImportError:
        raise ScenarioError("data frames need pandas: pip install pandas") from None
    return pandas
