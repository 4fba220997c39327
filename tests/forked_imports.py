"""What processes of ``forked.py`` have imported before they begin."""

from importlib import import_module

for name in (
    "torchrl.collectors",
    "torchrl.objectives",
    "nfv_torchrl.env",
    "nfv_torchrl.evaluation.figures",
    "nfv_torchrl.methods",
    "nfv_torchrl.training.cli",
    "nfv_torchrl.training.logger",
):
    import_module(name)
