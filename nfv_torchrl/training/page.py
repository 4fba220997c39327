"""What TensorBoard's tab "Text" says in words: what a run is, how to read it, and how it stands."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from nfv_torchrl.scenario.scenario import Scenario
from nfv_torchrl.training.references import EXACT, References

HOW_TO_READ = """\
## How to read it

- **Custom Scalars** is the tab to begin with. Its first chart shows AAR, the share of requests that are accepted: of
  the agent (`eval/aar`), of the rules it should beat, and the bound that nothing can exceed. The agent learns if its
  line rises. It is worth having once it is above `greedy`.
- **Paired cost** is what the agent pays over what a rule pays, for the requests that both accept. Below 1 it is
  cheaper.
- **Rejected by reason** is stacked: the gap between two lines is the share of one reason, and the highest line is all
  that is rejected.
- `eval/...` is the policy acting greedily on workloads that training never sees. `train/...` is the policy while it
  explores; it is worse, and noisy.
- **Images** shows how much the network is used, and some requests as the agent answers them, beside the exact search.
  The square is the ingress, the diamond the last node, and *f1*, *f2* ... are the functions of the chain where they
  were placed. A red walk was rejected.
- **Histograms**: `values` are the network's outputs for the action taken and for the best other one (of a policy
  gradient: before they become probabilities). Where both are alike, the agent does not care.
- Series that never change are left out. TensorBoard shows ten pictures and texts of a run; with
  `--samples_per_plugin images=100,text=100` it shows them all.
"""


def what_you_see(scenario: Scenario, config: Mapping[str, Any], references: References | None) -> str:
    """The page: the run, its scenario with offered load, what the references reach, and how to read it (Markdown)."""
    seeds = config["eval"]["seeds"]
    lines = [
        "# What you see",
        "",
        f"A training with `{_name(config['loss'])}` and `{_name(config['network'])}`, seed {config['seed']}, "
        f"evaluated on the workload seeds {seeds}.",
        "",
        f"Scenario `{scenario.name}`: {scenario.substrate.num_nodes} nodes, {scenario.substrate.num_links} links, "
        f"{scenario.arrival_rate:g} requests a second that stay {scenario.usual_lifetime:g} s on average. The offered "
        f"load rho is {scenario.offered_load():.2f}: {_load(scenario.offered_load())}.",
        "",
    ]
    return "\n".join([*lines, *_compared(references)]) + HOW_TO_READ


def what_evolves(config: Mapping[str, Any], horizons: int, references: References | None) -> str:
    """The page of an evolution, whose policy is measured on so many held-out horizons (Markdown)."""
    lines = [
        "# What you see",
        "",
        f"An evolution of `{_name(config['policy'])}`, seed {config['seed']}. A frame is one request answered. The "
        f"centre of the search is evaluated on {horizons} held-out horizons, each with a network and requests of its "
        "own or of the scenario, as `tasks` says. Numbers of rules are means over the same horizons.",
        "",
    ]
    return "\n".join([*lines, *_compared(references)]) + HOW_TO_READ


def standing(
    scores: Mapping[str, float], values: Mapping[str, float], references: References | None, frames: int
) -> str:
    """One sentence on how the agent stands after so many frames.

    Args:
        scores: its metrics.
        values: what was logged, by tag.
        references: what it is compared with, if it is.
        frames: learned from so far.
    """
    start = "Before training, the agent" if frames == 0 else f"After {frames:,} frames the agent"
    said = f"{start} accepts {scores['aar']:.1%} of the requests"
    if references is not None:
        below = [name for name, its in references.metrics.items() if scores["aar"] > its["aar"] + 5e-4]
        above = [name for name, its in references.metrics.items() if scores["aar"] < its["aar"] - 5e-4]
        parts = [f"{word} {_list(names)}" for word, names in (("more than", below), ("fewer than", above)) if names]
        said += ", " + " and ".join(parts) if parts else ", as many as all that it is compared with"
        ratio = values.get("eval/paired_cost/greedy", math.nan)
        if not math.isnan(ratio):
            how = f"{abs(ratio - 1):.0%} {'more' if ratio > 1 else 'less'} than"
            said += f"; for the same requests it pays {how if abs(ratio - 1) >= 0.005 else 'as much as'} greedy"
    reasons = {key: share for key, share in scores.items() if key.startswith("rejected/") and share > 0}
    if reasons:
        worst = max(reasons, key=lambda key: reasons[key])
        said += f"; most of what it rejects it rejects for {worst.partition('/')[2].replace('_', ' ')}"
    return said + "."


def _compared(references: References | None) -> list[str]:
    return [] if references is None else ["## What it is compared with", "", *_table(references), ""]


def _table(references: References) -> list[str]:
    rows = ["| | AAR | cost of an accepted request, $ | links |", "|---|---|---|---|"]
    for name, its in references.metrics.items():
        rows.append(f"| `{name}` | {its['aar']:.3f} | {its['cost_per_accepted']:.0f} | {its['mean_hops']:.1f} |")
    if not math.isnan(references.bound):
        rows.append(f"| bound | {references.bound:.3f} | | |")
    about = (
        f"`{EXACT}` finds the cheapest walk of every request by itself, exactly. `random_feasible` takes a random one "
        "of the steps that can still succeed. The bound is proved: no method accepts more."
    )
    return [*rows, "", about]


def _load(rho: float) -> str:
    if rho < 0.95:
        return "nearly everything could be accepted"
    return "about as much as the network holds" if rho < 1.2 else "far more than the network holds, so much is rejected"


def _list(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _name(part: Mapping[str, Any]) -> str:
    return str(part["_target_"]).rpartition(".")[2]
