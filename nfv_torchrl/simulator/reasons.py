"""Why a request was rejected."""

from enum import IntEnum


class Reason(IntEnum):
    """Rejection reasons; the lower-case name is what files and TensorBoard show.

    The first four are the step checks of Algorithm 3 in the order they are made, the rest are the controller's.
    """

    LINK_CAPACITY = 0
    VM_CAPACITY = 1
    DELAY = 2
    STEP_LIMIT = 3
    NO_FEASIBLE_ACTION = 4
    REJECTED_BY_POLICY = 5
    INVALID_ACTION = 6


NO_REASON = -1
"""Code of a request that was accepted, or not yet answered."""

REASON_NAMES: tuple[str, ...] = tuple(reason.name.lower() for reason in Reason)
