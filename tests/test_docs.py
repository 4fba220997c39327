"""The documentation builds without a warning and leaves out no part of the package."""

import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import nfv_torchrl

ROOT = Path(__file__).parents[1]
NOT_FOR_USERS = {"cli", "files", "folders", "inputs", "locks"}


def test_the_site_builds_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stdout + done.stderr
    losses = (tmp_path / "site" / "api" / "losses.html").read_text()
    assert "nfv_torchrl.losses.dqn.DQN" in losses


def test_every_room_has_its_page_in_the_reference():
    written = "".join(path.read_text() for path in (ROOT / "docs" / "api").glob("*.md"))
    rooms = {module.name for module in pkgutil.iter_modules(nfv_torchrl.__path__)} - NOT_FOR_USERS
    assert not {room for room in rooms if f"::: nfv_torchrl.{room}\n" not in written}
