"""The one table of every quantity that is logged, tabled or audited: its name, unit, meaning, and where it appears.

TensorBoard tags, keys of `metrics.json`, rows and columns of CSV files, heads of printed tables and the audit take
their names from here, so that `train/X` and `eval/X` are the same X. `docs/metrics.md` prints it:

    python -m nfv_torchrl.vocabulary
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

Place = Literal["train", "eval", "speed", "files", "summary", "figures"]
Form = Literal["share", "percent", "amount"]

PLACES: dict[Place, str] = {
    "train": "TensorBoard, `train/NAME`: over the steps since the last log line, while it explores",
    "eval": "TensorBoard, `eval/NAME`: the mean over the held-out workloads, acting greedily",
    "speed": "TensorBoard, `speed/NAME`",
    "files": "of each run: `metrics.json`, `per_seed.csv`, `summary.csv`",
    "summary": "of a comparison: `summary.csv` and tables of recipes, against what the column `reference` names",
    "figures": "the cells behind figures and tables of `experiments/`",
}
SHARE, DOLLARS, SECONDS = "share", "$", "s"
INTERVAL_COLUMNS = ("mean", "ci_low", "ci_high", "n")
SUMMARY_COLUMNS = ("method", "metric", *INTERVAL_COLUMNS, "reference", "scenario", "colocation", "observe_lifetime")
PER_SEED_COLUMNS = ("method", "seed", "metric", "value", "scenario_seed", "rho")


@dataclass(frozen=True)
class Quantity:
    """One row of the table.

    Attributes:
        name: what follows `train/` or `eval/`. A word in capitals after a slash stands for the parts of a whole:
            `aar/SERVICE` is there for every service, as `aar/web`.
        unit: of the number, empty for a plain number.
        meaning: what it is, in a line.
        where: the places it appears in, see `PLACES`.
        head: its column in printed tables, before the part; None: it is in none.
        form: how they show it.
        details: in the second table, which leaves out columns of zeros, not in the first.
        train: two totals of `TrainingWindow` whose ratio is `train/NAME`; None: something else logs it.
        measured: by the run alone, such as wall time: an audit cannot recompute it, and its spread over seeds says
            nothing.
    """

    name: str
    unit: str
    meaning: str
    where: tuple[Place, ...] = ("eval", "files")
    head: str | None = None
    form: Form = "amount"
    details: bool = False
    train: tuple[str, str] | None = None
    measured: bool = False

    @property
    def part(self) -> str:
        """The word in capitals that its parts stand for, empty if it has none."""
        return self.name.partition("/")[2]

    def key(self, part: str = "") -> str:
        """Its name with ``part`` in place of the word in capitals: `aar/web`."""
        return f"{self.name.removesuffix(self.part)}{part}" if self.part else self.name


_LOGGED: tuple[Place, ...] = ("train", "eval", "files")
_LEARNER: tuple[Place, ...] = ("train",)
_EVALUATION: tuple[Place, ...] = ("eval",)
_SUMMARY: tuple[Place, ...] = ("summary",)
_EVOLUTION: tuple[Place, ...] = ("train", "eval")
_FIGURES: tuple[Place, ...] = ("figures",)

TABLE: dict[str, Quantity] = {}
"""The rows by name, in the order of files and tables."""


def add(row: Quantity) -> Quantity:
    """Put a row into the table, at its end, and return it. A row that is there already stays where it is.

    Raises:
        ValueError: another row has that name.
    """
    if TABLE.setdefault(row.name, row) != row:
        raise ValueError(f"{row.name} is in the table already; choose another name")
    return row


for _row in (
    # Of a run. Those of `train` are ratios of totals; requests and slots of the warm-up count nowhere.
    Quantity("rho", "", "offered load: of the requests that would run at the end if all were accepted, over capacity"),
    Quantity("arrived", "", "requests that arrived"),
    Quantity("accepted", "", "requests that were accepted"),
    Quantity("aar", SHARE, "acceptance ratio: accepted / arrived", _LOGGED, "AAR", "share",
             train=("accepted", "arrived")),
    Quantity("aar/SERVICE", SHARE, "the same of one service", _LOGGED, "AAR ", "share",
             train=("accepted", "arrived")),
    Quantity("anuc", DOLLARS, "cost of all running requests, mean over slots", _LOGGED, "ANUC $",
             train=("slot_cost", "slots_closed")),
    Quantity("cost_per_accepted", DOLLARS, "cost phi of an accepted request, mean", _LOGGED, "cost/accepted $",
             train=("request_cost", "accepted")),
    Quantity("cost_per_accepted/SERVICE", DOLLARS, "the same of one service", head="cost $ ",
             details=True),
    Quantity("rejected/REASON", SHARE, "requests rejected for that reason / arrived", _LOGGED, "", "percent",
             details=True, train=("rejected", "arrived")),
    Quantity("refused/SERVICE", SHARE,
             "requests of one service that the method itself rejected, also for want of a walk / arrived",
             ("eval", "files"), "refused ", "percent", details=True),
    Quantity("mean_hops", "links", "links used by an accepted request, each as often as it is used, mean", _LOGGED,
             "hops", train=("request_hops", "accepted")),
    Quantity("mean_delay_ms", "ms", "delay of an accepted request, mean", _LOGGED, "delay ms",
             train=("request_delay", "accepted")),
    Quantity("vm_utilisation", SHARE, "used / total capacity of all VMs, mean over slots", _LOGGED, "VM use", "share",
             train=("slot_vm_use", "slots_closed")),
    Quantity("vm_utilisation_peak", SHARE, "its largest value"),
    Quantity("link_utilisation", SHARE, "used / total capacity of all links, mean over slots", _LOGGED, "link use",
             "share", train=("slot_link_use", "slots_closed")),
    Quantity("link_utilisation_peak", SHARE, "its largest value"),
    Quantity("interrupted", SHARE, "requests cut short by a failure / accepted", _LOGGED, "interrupted", "percent",
             details=True, train=("interrupted", "accepted")),
    Quantity("lost_service_time", SECONDS, "slots that the interrupted requests still had to run, in all",
             head="lost s", details=True),
    Quantity("rac", SHARE, "acceptance as Virne defines it, which is `aar`; this and the two below where requests "
             "of a file bring demands", ("eval", "files"), "RAC", "share"),
    Quantity("lrc", "ratio", "revenue / cost of the accepted requests, each times its lifetime: amounts asked for, "
             "mean over kinds, plus rates of segments, over the same with each rate times its hops", ("eval", "files"),
             "LRC", "share"),
    Quantity("lar", "1/s", "their revenue times lifetime, in all / time of the last arrival", ("eval", "files"), "LAR"),
    Quantity("unproved", "", "requests of the whole run whose search reached its limit (`labels`), so that the answer "
             "is not proved optimal; of methods with a limit", ("files",), "unproved", details=True, measured=True),
    Quantity("decision_seconds", SECONDS, "wall time of the decisions of the whole run", ("files",), measured=True),
    Quantity("decisions_per_second", "1/s", "requests answered per second of it", ("files",), "decisions/s",
             measured=True),
    # Of two methods on the same requests, or of a method and a bound.
    Quantity("aar_iqm", SHARE, "interquartile mean of `aar` over training seeds and workloads", _SUMMARY, "AAR IQM"),
    Quantity("training_frames", "", "frames that a training took", _SUMMARY, "frames"),
    Quantity("training_seconds", SECONDS, "processor time that a training took", _SUMMARY, "processor s"),
    Quantity("aar_difference", SHARE, "`aar` minus that of the reference, paired by seed", _SUMMARY, "AAR difference"),
    Quantity("aar_difference_lowest", SHARE, "`aar_difference` of the training seed that is lowest", _SUMMARY),
    Quantity("aar_relative_difference", SHARE, "`aar_difference` / mean `aar` of the reference", _SUMMARY, "relative"),
    Quantity("anuc_relative_difference", SHARE, "`anuc` minus that of the reference, / its mean", _FIGURES),
    Quantity("paired_cost", "ratio", "cost over that of the reference, over the requests that both accept",
             ("train", "eval", "summary"), "paired cost"),
    Quantity("paired_cost/METHOD", "ratio", "the same, against `greedy` and `myopic_optimal`", _EVALUATION),
    Quantity("aar_of/METHOD", SHARE, "`aar` of what a training is compared with, such as `bound`", _EVALUATION),
    Quantity("cost_per_accepted_of/METHOD", DOLLARS, "`cost_per_accepted` of the same", _EVALUATION),
    Quantity("held_out_aar", SHARE, "`aar` on the networks of `eval.networks`, mean", _EVALUATION),
    Quantity("held_out_paired_cost", "ratio", "`paired_cost` over `myopic_optimal` on the same, mean", _EVALUATION),
    Quantity("held_out_score", "", "`held_out_aar` less a tenth of what that cost has above 1; the best is kept",
             _EVALUATION),
    Quantity("gap_closed", SHARE, "how much of the way in `aar` from `myopic_optimal` to a bound it goes", _SUMMARY,
             "gap closed"),
    Quantity("aar_bound", SHARE, "an upper bound on `aar`", _SUMMARY, "bound"),
    # Of evaluations in a training, beside the metrics of a run.
    Quantity("rejected_stacked/REASON", SHARE, "`rejected` of that reason and of those before it, added up",
             _EVALUATION),
    Quantity("steps/KIND", SHARE, "steps of walks: a hop with a placement (`place`), a hop (`forward`), a placement "
             "without a hop (`stay`), a refusal (`reject`)", _EVALUATION),
    Quantity("chosen_value", "", "the network's output for the actions taken, mean", _EVALUATION),
    # Of the learner: what the last update said.
    Quantity("loss", "", "what is minimised: the sum of the parts of the loss", _LEARNER),
    Quantity("gradient_norm", "", "norm of its gradient before clipping", _LEARNER),
    Quantity("reward", "", "reward of a step, mean over the last batch", _LEARNER),
    Quantity("epsilon", SHARE, "steps at which a random valid action is taken", _LEARNER),
    Quantity("chosen_q", "", "value of the actions taken, mean over the last batch", _LEARNER),
    Quantity("td_error", "", "absolute temporal difference, mean", _LEARNER),
    Quantity("reward_rate", "", "reward per second that the loss has learned, mean over services", _LEARNER),
    Quantity("quantile_spread", "", "distance of the quantiles' ends, mean", _LEARNER),
    Quantity("agreement", SHARE, "recorded actions that are also the policy's first choice", _LEARNER),
    Quantity("entropy", "nats", "entropy of the policy over valid actions, mean", _LEARNER),
    Quantity("log_policy", "", "temperature times the log-probability of the actions taken, clipped, mean", _LEARNER),
    Quantity("accepting", SHARE, "steps that accepted a request and are not learned from", _LEARNER),
    Quantity("cross_entropy", "nats", "minus log-probability of the actions taken, mean", _LEARNER),
    Quantity("pred_value", "", "value of the actions taken, mean over the last update's rows", _LEARNER),
    Quantity("target_value", "", "what it should be, mean over the same rows", _LEARNER),
    Quantity("alpha", "", "weight of the entropy", _LEARNER),
    Quantity("kl_approx", "nats", "how far the policy moved since the batch was collected, estimated", _LEARNER),
    Quantity("clip_fraction", SHARE, "actions whose probability ratio was clipped", _LEARNER),
    Quantity("ESS", "", "effective sample size of the probability ratios", _LEARNER),
    Quantity("mean_ratio", "", "probability ratio of the actions taken, after over before, mean", _LEARNER),
    Quantity("max_ratio", "", "the largest", _LEARNER),
    Quantity("value_clip_fraction", SHARE, "state values whose change was clipped", _LEARNER),
    Quantity("explained_variance", SHARE, "variance of the returns that the state values explain", _LEARNER),
    Quantity("loss_td", "", "part of the loss: temporal differences", _LEARNER),
    Quantity("loss_conservative", "", "part of the loss: what CQL takes from actions that were not recorded", _LEARNER),
    Quantity("loss_cql", "", "the same of TorchRL's class", _LEARNER),
    Quantity("loss_qvalue", "", "part of the loss: of the values", _LEARNER),
    Quantity("loss_value", "", "part of the loss: of the state values", _LEARNER),
    Quantity("loss_critic", "", "part of the loss: of the state values, weighted", _LEARNER),
    Quantity("loss_actor", "", "part of the loss: of the policy", _LEARNER),
    Quantity("loss_objective", "", "part of the loss: of the policy", _LEARNER),
    Quantity("loss_entropy", "", "part of the loss: the bonus for entropy", _LEARNER),
    Quantity("loss_alpha", "", "part of the loss: of the weight of the entropy", _LEARNER),
    # Of evolution.
    Quantity("fitness", "", "what evolution maximises, mean over horizons", _EVOLUTION),
    Quantity("aar_gain", SHARE, "`aar` minus that of `myopic_optimal` on the same requests", _EVOLUTION),
    Quantity("fitness_best", "", "of the fittest candidate of the generation", _LEARNER),
    Quantity("sigma", "", "step size of the search", _LEARNER),
    # How fast it goes.
    Quantity("frames_per_second", "1/s", "decisions per second of training, with all that it stops for", ("speed",)),
    Quantity("frames_per_processor_second", "1/s", "decisions per second of processor time, counted as "
             "`processor_seconds` are", ("speed",)),
    Quantity("updates_per_second", "1/s", "updates per second that the learner is at work", ("speed",)),
    Quantity("evaluation_seconds", SECONDS, "wall time of an evaluation, without its figures", ("speed",)),
    Quantity("processor_seconds", SECONDS, "processor time of a training so far: collecting, learning, log lines and "
             "checkpoints, without starting up, evaluations, compiling and other processes", ("speed", "figures")),
    Quantity("requests_per_second", "1/s", "requests that evolution plays per second", ("speed",)),
    # More of a run, for figures.
    Quantity("mean_steps", "steps", "steps of an accepted request's walk, mean", _FIGURES),
    Quantity("paper_reward", "", "the paper's reward, both weights 1, for an accepted request, mean", _FIGURES),
    Quantity("turned_away/SERVICE", SHARE,
             "requests of one service that were rejected although the exact search had a walk for them / arrived",
             _FIGURES, "turned away ", "percent"),
    Quantity("frames", "", "decisions of the whole horizon", _FIGURES),
    Quantity("aar_share", SHARE, "`aar` over that of `myopic_optimal` on the same requests", _FIGURES),
    Quantity("aar_share_untrained", SHARE, "the same before the training", _FIGURES),
    Quantity("aar_share_best", SHARE, "its highest value in a training, untrained or at an evaluation", _FIGURES),
    Quantity("seconds_to/SHARE", SECONDS, "`processor_seconds` at the first evaluation at which `aar_share` is at "
             "least that", _FIGURES),
    Quantity("frames_to/SHARE", "", "decisions of the training until then", _FIGURES),
):  # fmt: skip
    add(_row)


def in_place(place: Place) -> list[Quantity]:
    """The rows that appear somewhere, in order."""
    return [row for row in TABLE.values() if place in row.where]


def find(key: str) -> tuple[Quantity, str] | None:
    """The row of a name such as `aar/web`, and its part (`web`, or empty); None if there is none."""
    if key in TABLE:
        return TABLE[key], ""
    whole, _, part = key.partition("/")
    for row in TABLE.values():
        if row.part and row.name == f"{whole}/{row.part}":
            return row, part
    return None


def without_row(tags: Iterable[str]) -> list[str]:
    """TensorBoard tags that no row of the table names: those of a loss or recipe of your own."""
    found = []
    for tag in tags:
        place, _, key = tag.partition("/")
        row = find(key)
        if row is None or place not in row[0].where:
            found.append(tag)
    return found


def markdown() -> str:
    """The table as `docs/metrics.md` prints it."""
    return "\n".join(_lines())


def _lines() -> Iterator[str]:
    yield "| name | unit | what it is | where | printed as |"
    yield "|---|---|---|---|---|"
    for row in TABLE.values():
        head = "" if row.head is None else f"{row.head}{row.part}"
        audited = "summary" in row.where or ("files" in row.where and not row.measured)
        where = ", ".join([*row.where, *(["audit"] if audited else [])])
        yield f"| `{row.name}` | {row.unit} | {row.meaning} | {where} | {head} |"


if __name__ == "__main__":
    print(markdown())
