"""The field's benchmark: methods on networks and requests that others use, beside what others publish of them.

    python recipes/field.py                                  # Virne's chains on Waxman-100
    python recipes/field.py only=[geant,brain] method=[greedy] reference=greedy
    python recipes/field.py set=traffic                      # Abilene, GEANT and Germany50, arrivals by their traffic
    python recipes/field.py seeds=3 "+method.mine={_target_: my_package.Mine}"
    python recipes/field.py checkpoints=[a.pt,b.pt] method=[myopic_optimal,checkpoint]    # of several training seeds
    python recipes/field.py freeze=docs/benchmark/chains.json    # the manifest that decisions are scored against

Every method at every network and load is a cell of its own, audited, that is not computed again.

Writes to ``output``: ``field.md``, ``field.csv``, ``field.png`` and ``.pdf``, and ``cells``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.evaluation.figures import save_figure
from nfv_torchrl.evaluation.score import check_place, freeze
from nfv_torchrl.experiments.cells import CellStore
from nfv_torchrl.experiments.computing import compute_shown
from nfv_torchrl.experiments.field import field_figure, field_table, place_rows, places_of, published_rows, runs_of
from nfv_torchrl.experiments.transfer import POLICY, policy_files, with_policies
from nfv_torchrl.files import write_atomically
from nfv_torchrl.folders import claim
from nfv_torchrl.settings.recipes import FieldSettings, read_settings
from nfv_torchrl.training.cli import recipe
from nfv_torchrl.training.setup import run_folder


@recipe("field")
def main(cfg: DictConfig) -> None:
    read_settings(cfg, FieldSettings)
    config = cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True))
    if POLICY in config["method"]:
        config["method"] = with_policies(config["method"], policy_files(config))
    store = CellStore(run_folder(config["output"], "output"), Path(__file__).parent)
    places = places_of(config, Path(__file__).parent)
    if config["freeze"]:
        check_place(Path(config["freeze"]))
    claim("output", store.folder, "cells")
    failures = compute_shown([cell for place in places for cell in place.cells], store, instantiate(cfg.parallel))

    there = [place for place in places if all(map(store.has, place.methods.values()))]
    rows = [row for place in there for row in place_rows(place, store, config["reference"])]
    rows += published_rows(config["published"], there)
    about = f"{config['title']}, {config['seeds']} seeds"
    table = field_table(about, rows, config["reference"], config["axis"])
    write_atomically(store.folder / "field.md", table.markdown() + "\n")
    print(f"\n{table.text()}")
    if there:
        caption = "Mean over seeds and its 95 % interval; what others publish has none."
        save_figure(field_figure(about, rows, config["axis"], caption), rows, store.folder / "field")
    if config["freeze"]:
        freeze(Path(config["freeze"]), config["title"], {k: run for place in there for k, run in runs_of(place, store)})
    print(f"\nTable, picture and cells: {store.folder}")
    if failures:
        raise ScenarioError("\n  ".join(["some runs failed:", *(f"{key}: {text}" for key, text in failures.items())]))


if __name__ == "__main__":
    main()
