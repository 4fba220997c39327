"""Presets of dqn.py: no setting of theirs goes without effect."""

from pathlib import Path

import pytest
from hydra import compose
from omegaconf import OmegaConf

from nfv_torchrl.cli import recipes_folder
from nfv_torchrl.training.cli import recipe_configs

PRESETS = recipes_folder() / "config" / "preset"


def leaves(settings, before=()):
    for key, value in settings.items():
        if isinstance(value, dict):
            yield from leaves(value, (*before, key))
        else:
            yield (*before, key), value


@pytest.mark.parametrize("preset", sorted(PRESETS.glob("*.yaml")), ids=lambda path: Path(path).stem)
def test_every_setting_of_a_preset_is_what_runs(preset):
    said = OmegaConf.to_container(OmegaConf.load(preset), resolve=False)
    said.pop("defaults", None)
    with recipe_configs(recipes_folder()):
        runs = OmegaConf.to_container(compose("dqn", [f"preset={preset.stem}"]), resolve=False)
    for path, value in leaves(said):
        here = runs
        for key in path:
            here = here[key]
        assert here == value, ".".join(path)
