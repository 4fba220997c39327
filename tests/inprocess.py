"""Running recipes inside the test's own process, which saves the seconds that importing takes."""

from __future__ import annotations

import functools
import importlib.util
from types import ModuleType, SimpleNamespace
from unittest.mock import patch

from forked import ForkedTraining
from hydra import compose, initialize_config_dir
from tiny import ROOT

from nfv_torchrl.experiments import training
from nfv_torchrl.settings.torchrl_losses import forget_other_loss


@functools.cache
def recipe(name: str) -> ModuleType:
    """The module ``recipes/NAME.py``."""
    spec = importlib.util.spec_from_file_location(f"recipe_{name}", ROOT / "recipes" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def call(name: str, *overrides: str) -> None:
    """Run ``recipes/NAME.py`` with ``overrides`` to its end.

    Trainings that it starts are forked (``forked.py``); test_training_cells.py has those that begin with Python itself.

    Raises:
        SystemExit: with code 2, after an expected error.
    """
    with initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        config = compose(name, overrides=list(overrides))
    forget_other_loss(config, overrides)
    with patch.object(training, "subprocess", SimpleNamespace(Popen=ForkedTraining)):
        recipe(name).main(config)
