"""``render()``: the network as it is now, as a picture."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from nfv_torchrl.codec import count_vms
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.network_figure import draw_network
from nfv_torchrl.simulator import Simulator

MODES = ["rgb_array"]
FPS = 4
"""Pictures a second of a film: each shows one step of a walk."""
MARKS = {"ingress": ("tab:green", 1.9), "egress": ("tab:red", 1.9), "node": ("tab:orange", 1.3)}
"""Colour of the ring around a node, and its width over that of the node's circle."""


def check_mode(mode: str | None) -> str | None:
    """``mode`` if there is such a render mode.

    Raises:
        ScenarioError: there is not.
    """
    if mode is not None and mode not in MODES:
        raise ScenarioError(f"render_mode: {mode!r} is none of {MODES}; leave it out for no pictures")
    return mode


class NetworkPicture:
    """The network of an environment: used shares of nodes and links now, and where the walk in hand is.

    Rings mark the ingress (green), the egress (red) and the node the walk is at (orange). Nodes are laid out and drawn
    once; a picture changes colours and rings.

    Args:
        simulator: all environments are on the network of its first scenario.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.substrate = simulator.scenario(0).substrate
        node_use, link_use = self._use(0)
        self._drawing = draw_network(self.substrate, node_use, link_use, "used share now")
        self._canvas = FigureCanvasAgg(self._drawing.figure)
        places = np.array([self._drawing.place[node] for node in range(self.substrate.num_nodes)])
        sizes = self._drawing.nodes.get_sizes()
        self._places, self._sizes = places, np.broadcast_to(sizes, len(places))
        self._rings = {
            name: self._drawing.axes.scatter(*places[:1].T, facecolors="none", edgecolors=colour, linewidths=3)
            for name, (colour, _) in MARKS.items()
        }

    def draw(self, b: int) -> np.ndarray:
        """The network of environment b, uint8 [height, width, 3]."""
        env = self.simulator.world.env[b]
        node_use, link_use = self._use(b)
        self._drawing.nodes.set_array(node_use)
        self._drawing.links.set_array(link_use)
        for name, ring in self._rings.items():
            node = max(int(env[name]), 0)
            ring.set_offsets(self._places[node])
            ring.set_sizes([self._sizes[node] * MARKS[name][1]])
            ring.set_visible(not env["done"] and env[name] >= 0)  # an end may be free
        self._drawing.axes.set_title(self._title(b), fontsize=12)
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _title(self, b: int) -> str:
        env = self.simulator.world.env[b]
        if env["done"]:
            return f"slot {env['slot']}: end of the horizon"
        kind = self.simulator.scenario(b).catalogue.types[int(env["service"])]
        placed = f"{env['function']} of {self.simulator.tables.chain_length[int(env['profile'])]} functions placed"
        ends = ("any" if env[end] < 0 else env[end] for end in ("ingress", "egress"))
        return f"slot {env['slot']}: {kind.name}, node {' to '.join(map(str, ends))}, {placed}"

    def _use(self, b: int) -> tuple[np.ndarray, np.ndarray]:
        """Used share of the VMs of each node, float64 [N], and of each link, float64 [L].

        Of the first kind of resources; with full duplex of the direction that is used more.
        """
        _, nodes, vms, kinds = self.simulator.world.ledger.vm_offered.shape
        flat = self.simulator.world.seen.flat[b].astype(np.float64)
        capacity = self.simulator.tables.vm_capacity[int(self.simulator.world.env["net"][b]), :, :, 0]
        first = kinds * count_vms(nodes, vms)
        used = flat[:first].reshape(nodes, vms, kinds)[:, :, 0] * capacity
        ways = 2 if self.substrate.full_duplex else 1
        links = flat[first : first + ways * self.substrate.num_links].reshape(-1, ways)
        return used.sum(1) / np.maximum(capacity.sum(1), 1), links.max(1)
