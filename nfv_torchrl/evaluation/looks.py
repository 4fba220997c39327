"""One colour and marker for one method, in every picture: add yours to ``LOOKS``."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import NamedTuple


class Look(NamedTuple):
    """Colour, marker and, of what is no method of ours (rules, bounds, theory), a line that is not solid."""

    colour: str
    marker: str
    line: str = "-"


# The methods that stand beside each other most have the colours of Okabe and Ito, which stay apart for colour-blind
# readers; markers stay apart in black and white.
_AGENT = Look("#0072B2", "o")
LOOKS: dict[str, Look] = {
    "DQN-AR": _AGENT,
    "DQN over plans": Look("#4B0082", "h"),
    "DQN-AR with look-ahead": Look("#CC3311", "<"),
    "DQN-AR, default reward": _AGENT,
    "DQN-AR, paper's reward": Look("#8C564B", "*"),
    "greedy": Look("#D55E00", "s"),
    "tabu": Look("#009E73", "^"),
    "NFVdeep": Look("#CC79A7", "D"),
    "myopic_optimal": Look("#E69F00", "v"),
    "priced": Look("#56B4E9", "P"),
    "priced_admit": Look("#000000", "X"),
    "milp": Look("#B8860B", "h"),
    "first_fit": Look("#7B68EE", "p"),
    "random_feasible": Look("#999999", "d"),
    "random": Look("#BBBBBB", "."),
    "untrained": Look("#666666", "<"),
    "bound: hindsight": Look("#777777", "*", "--"),
    "bound: blind": Look("#777777", "*", ":"),
    # Agents by the names of their presets and recipes.
    "mlp": _AGENT,
    "candidate": Look("#E69F00", "P"),
    "lookahead": Look("#009E73", "^"),
    "plans": Look("#D55E00", "s"),
    "nfvdeep": Look("#CC79A7", "D"),
    "maskable_ppo": Look("#666666", "v"),
    # Losses, which are compared with each other and with the rules above.
    "dqn": _AGENT,
    "prioritized": Look("#EE6677", "X"),
    "double_dqn": Look("#332288", "s"),
    "n_step": Look("#117733", "^"),
    "dueling": Look("#88CCEE", "D"),
    "distributional": Look("#882255", "v"),
    "munchausen": Look("#AA4499", "P"),
    "iqn": Look("#44AA99", "X"),
    "rainbow": Look("#CC3311", "*"),
    "paper_literal": Look("#8C564B", "h"),
    "noisy": Look("#8B0000", "d"),
    "discrete_sac": Look("#999933", "<"),
    "gru": Look("#1F4E3D", ">"),
    "rdpg": Look("#EE3377", "p"),
    "reinforce": Look("#5D8AA8", "s"),
    "a2c": Look("#2CA02C", "^"),
    "ppo": Look("#7B3F00", "D"),
    "recurrent_ppo": Look("#B15928", "v"),
    "cql": Look("#4B0082", "P"),
    "imitation": Look("#556B2F", "X"),
}
SPARE = (
    Look("#440154", "o"), Look("#277F8E", "s"), Look("#7AD151", "^"), Look("#46327E", "D"), Look("#1F9E70", "v"),
    Look("#BDBF1A", "P"), Look("#365C8D", "X"), Look("#4AC16D", "*"),
)  # fmt: skip
"""For series that are no methods of the table, such as sizes, in order; colours that no method has."""


def looks(names: Iterable[str]) -> dict[str, Look]:
    """The look of every series of a picture; of names that the table lacks, one that no other series there has."""
    wanted = list(dict.fromkeys(names))
    taken = {LOOKS[name].colour for name in wanted if name in LOOKS}
    free = itertools.cycle([look for look in SPARE if look.colour not in taken] or SPARE)
    return {name: LOOKS[name] if name in LOOKS else next(free) for name in wanted}
