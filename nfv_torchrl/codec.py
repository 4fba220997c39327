"""Actions and resources as whole numbers, packed and unpacked here only; for plain Python, NumPy arrays and kernels.

N nodes of at most V VMs each and L links. An action says to which node a step goes, which VM it names there and
whether the next function is placed on it; the last of all, ``reject``, answers the request. Resources are numbered
VMs first, node by node, then links.
"""

from __future__ import annotations

from numba.extending import register_jitable


@register_jitable
def count_actions(nodes, vms):
    """Actions with ``reject``: 2 N V + 1."""
    return 2 * nodes * vms + 1


@register_jitable
def encode_action(node, vm, places, vms):
    """The action of a step to ``node`` that names ``vm`` there; ``places``: the next function goes on it."""
    return 2 * (node * vms + vm) + places


@register_jitable
def decode_action(action, vms):
    """(node, VM, whether a function is placed) of an action other than ``reject``."""
    return action // (2 * vms), action // 2 % vms, action % 2 == 1


@register_jitable
def count_vms(nodes, vms):
    """Places for VMs, N V: the number of the first link among the resources."""
    return nodes * vms


@register_jitable
def vm_resource(node, vm, vms):
    """Number of a VM among the resources."""
    return node * vms + vm


@register_jitable
def link_resource(link, nodes, vms):
    """Number of a link among the resources."""
    return nodes * vms + link


@register_jitable
def use_of(profile, part, functions):
    """A function of a profile, or a segment of it, as one number; chains have at most ``functions`` functions."""
    return profile * (functions + 1) + part


@register_jitable
def split_use(use, functions):
    """(profile, function or segment) of such a number."""
    return use // (functions + 1), use % (functions + 1)


@register_jitable
def split_vm(resource, vms):
    """(node, VM) of a resource that is a VM."""
    return resource // vms, resource % vms
