"""The recipe runs and prints a row for every setting."""

import subprocess
import sys
from pathlib import Path

RECIPE = Path(__file__).parents[2] / "recipes" / "milp_gap.py"


def test_the_table_is_printed():
    command = [sys.executable, str(RECIPE), "--seeds", "2", "--requests", "2"]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    rows = [line.split(" | ") for line in lines if line.startswith("| ") and "%, " in line and "VMs" not in line]
    assert len(rows) == 8
    # The problem is never costlier: what a walk costs more is not negative.
    assert all(float(row[4].split("±")[0]) >= 0 for row in rows)
