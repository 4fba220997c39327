"""The first screen of TensorBoard's tab "Custom Scalars": which series stand in one chart, the most telling first.

Series are named by regular expressions, so that the layout is the same for all services, reasons and losses:
TensorBoard puts the layouts of several runs together chart by chart. A title has to fit in one line above its chart,
which are about 40 letters: a second line would lie on the chart.
"""

from __future__ import annotations

import re

Charts = dict[str, dict[str, list[str]]]
"""By category and title of the chart: expressions of the tags that are its lines."""

PAIRED = "paired cost: agent / rule, same requests"
EVALUATED: Charts = {
    "1 Does it learn, and is it better than the rules?": {
        "AAR: the agent, three rules, the bound": [
            r"eval/aar$", r"eval/aar_of/",
        ],
        "cost of an accepted request, $": [r"eval/cost_per_accepted$", r"eval/cost_per_accepted_of/"],
        PAIRED: [r"eval/paired_cost/"],
    },
    "2 What does it still reject?": {
        "AAR by service": [r"eval/aar/"],
        "rejected by reason, stacked (if any)": [r"eval/rejected_stacked/"],
        "what its steps do, shares": [r"eval/steps/"],
    },
}  # fmt: skip
"""Charts of evaluations, by category."""
HELD_OUT: dict[str, list[str]] = {
    "AAR on held-out networks": [r"eval/held_out_aar$"],
    "their paired cost: agent / myopic_optimal": [r"eval/held_out_paired_cost$"],
}
"""Where the policy that is kept is chosen on held-out networks, beside the charts of the first category."""
LEARNER: dict[str, list[str]] = {
    "loss": [r"train/loss$"],
    "Q of actions taken, or policy's entropy": [
        r"train/chosen_q$", r"train/entropy$", r"eval/chosen_value$",
    ],
    "gradient norm": [r"train/gradient_norm$"],
}  # fmt: skip
CURVES = [r"(train|eval)/(aar|anuc|cost_per_accepted|mean_hops)$"]
"""Of every run, so that learning curves can be drawn of any."""
BY_SERVICE = [r"eval/aar/"]
"""So that its chart is not empty where every service is accepted from the beginning."""
SPEED: dict[str, list[str]] = {"frames, updates, requests per second": [r"speed/.*_per_second$"]}
EVOLVED: Charts = {
    "1 Does it learn, and is it better than the rules?": {
        "AAR: the agent, three rules, the bound": [r"eval/aar$", r"eval/aar_of/"],
        "AAR above that of myopic_optimal": [r"eval/aar_gain$"],
        "paired cost: agent / myopic_optimal": [r"eval/paired_cost$"],
    },
    "2 How is the search?": {
        "fitness": [r"eval/fitness$", r"train/fitness$", r"train/fitness_best$"],
        "step size": [r"train/sigma$"],
    },
    "3 How fast is it?": SPEED,
}
"""All charts of an evolution."""


def charts(*, evaluated: bool, apart: bool, held_out: bool = False) -> Charts:
    """The charts of a training by loss.

    Args:
        evaluated: whether there are evaluations.
        apart: whether what the agent is compared with is in event files of its own (``RunLogger.apart``), with the
            agent's tags.
        held_out: whether there are evaluations on held-out networks, too.
    """
    learner: Charts = {"3 How does the learner do?": LEARNER, "4 How fast is it?": SPEED}
    if not evaluated:
        return learner
    first, *others = EVALUATED
    own = dict(EVALUATED[first])
    if apart:
        own = {title: tags[:1] for title, tags in own.items()} | {PAIRED: [r"eval/paired_cost$"]}
    return {first: own | (HELD_OUT if held_out else {})} | {title: EVALUATED[title] for title in others} | learner


def written_always(tag: str) -> bool:
    """Whether a series is written though it never changes: lines that others are read against, and curves."""
    first = next(iter(EVALUATED.values())) | next(iter(EVOLVED.values())) | HELD_OUT
    return any(re.match(pattern, tag) for patterns in [*first.values(), CURVES, BY_SERVICE] for pattern in patterns)


def as_layout(charts_by_category: Charts) -> dict[str, dict[str, list]]:
    """The charts as ``SummaryWriter.add_custom_scalars`` takes them."""
    return {
        category: {title: ["Multiline", tags] for title, tags in lines.items()}
        for category, lines in charts_by_category.items()
    }
