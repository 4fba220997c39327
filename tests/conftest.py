"""Settings that make every test run repeatable: one torch thread, and Hypothesis without deadlines."""

import os
import signal

import pytest
import torch
from hypothesis import HealthCheck, settings

# One thread: sums are added in one order, and two cores are not shared by more workers than they can carry.
torch.set_num_threads(1)

# A shell without job control starts its background jobs with Ctrl-C ignored, and what they start inherits that. Tests
# send it to themselves and to recipes.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# The first example of a test compiles kernels, so no deadline and no complaint about a slow start.
_common = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow], "print_blob": True}
settings.register_profile("local", max_examples=30, **_common)
settings.register_profile("ci", max_examples=30, derandomize=True, **_common)
settings.register_profile("thorough", max_examples=1000, **_common)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci" if os.environ.get("CI") else "local"))


@pytest.fixture(autouse=True, scope="session")
def logs_of_stable_baselines(tmp_path_factory):
    """It makes a folder for logs that it does not write, by default in the folder that all programs share."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("sb3"))
