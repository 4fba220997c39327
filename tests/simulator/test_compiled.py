"""What Numba caches on disk is compiled again when a module that it was compiled from has changed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from nfv_torchrl.simulator import compiled, kernels

CONSTANT = "from house.simulator.compiled import part\nLEVEL = {level}\n@part\ndef level():\n    return LEVEL\n"
CALLER = (
    "from house.simulator.compiled import kernel\nfrom house.simulator.low import level\n"
    "@kernel\ndef twice():\n    return 2 * level()\n"
)
RUN = "from house.simulator.high import twice; print(twice(), sum(twice.stats.cache_hits.values()))"


def call(folder: Path) -> list[str]:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")}
    answer = subprocess.run([sys.executable, "-c", RUN], cwd=folder, env=environment, capture_output=True, check=True)
    return answer.stdout.decode().split()


def test_change_in_a_module_below_compiles_anew(tmp_path: Path) -> None:
    package = tmp_path / "house" / "simulator"
    package.mkdir(parents=True)
    shutil.copy(compiled.__file__, package)
    (package / "high.py").write_text(CALLER)
    (package / "low.py").write_text(CONSTANT.format(level=1))
    assert call(tmp_path) == ["2", "0"]
    assert call(tmp_path) == ["2", "1"]
    (package / "low.py").write_text(CONSTANT.format(level=2))
    assert call(tmp_path) == ["4", "0"]


def test_kernels_are_stamped_with_their_sources() -> None:
    stamp = kernels.step_env._cache._cache_file._source_stamp
    assert stamp[1] == compiled.source_stamp(Path(kernels.__file__))
