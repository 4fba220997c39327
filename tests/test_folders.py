"""Whose folder is it: what is taken, what is refused, what a lock keeps apart."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from nfv_torchrl import folders, locks
from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.folders import MARKER, at_work, check_place, claim, claim_file, kind_of, refuse_foreign, set_aside
from nfv_torchrl.locks import Lock, locks_of_command

HOLD = """
import sys
from pathlib import Path
from nfv_torchrl.folders import claim
lock = claim("run_dir", Path(sys.argv[1]), "run")
print("held", flush=True)
sys.stdin.read()
"""


def old_run(folder: Path) -> Path:
    """What versions without markers left behind."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("scenario:\n  name: paper\nrun_dir: runs/dqn\n")
    (folder / "checkpoint_000000000064.pt").write_bytes(b"x")
    return folder


def tree(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_another_process_is_kept_out_until_it_dies(tmp_path):
    folder = tmp_path / "run"
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdin=-1, stdout=-1, text=True)
    try:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(ScenarioError, match=rf"^run_dir: .*run is in use by process {holder.pid} on .* since 20"):
            claim("run_dir", folder, "run")
        assert at_work(folder)
        folder.rename(tmp_path / "moved")  # the lock goes with it
        with pytest.raises(ScenarioError, match="in use"):
            claim("run_dir", tmp_path / "moved", "run")
        claim("run_dir", folder, "run").release()  # a new folder under the old name is free
    finally:
        holder.kill()
        holder.communicate()
    assert not at_work(tmp_path / "moved")
    claim("run_dir", tmp_path / "moved", "run").release()


def test_a_lock_knows_when_its_folder_was_moved(tmp_path):
    lock = claim("run_dir", tmp_path / "run", "run")
    assert lock.in_place()
    (tmp_path / "run").rename(tmp_path / "moved")
    assert not lock.in_place()
    claim("run_dir", tmp_path / "run", "run")
    assert not lock.in_place()


def test_locks_of_a_command_end_with_it(tmp_path):
    with pytest.raises(RuntimeError) as kept, locks_of_command():
        claim("output", tmp_path / "out", "cells")
        raise RuntimeError
    assert kept.value and not at_work(tmp_path / "out")


def test_without_locks_there_is_a_warning(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.warns(UserWarning, match="this file system has no locks"):
        assert claim("run_dir", tmp_path / "run", "run").in_place()


@pytest.mark.parametrize("note", [b"", b"\xff\xfe", b"[1]", b"{}", b"[" * 100_000])
def test_a_damaged_note_is_no_obstacle(tmp_path, note):
    held = Lock(tmp_path / "lock", "output: x", "cells")
    (tmp_path / "lock").write_bytes(note)
    with pytest.raises(ScenarioError, match="in use by another process"):
        Lock(tmp_path / "lock", "output: x", "cells")
    held.release()
    assert kind_of(tmp_path) is None


@pytest.mark.parametrize("value", [None, "", " ", ".", "..", "/", "~", "~/x", True, 1.5, [], {}, "a\0b", "x/..", "./"])
def test_what_names_no_folder_of_a_runs_own(value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ScenarioError, match=r"^run_dir: [^\n]*$"):
        check_place("run_dir", value)
    assert tree(tmp_path) == []


def test_home_and_folders_above_are_nobodys(tmp_path, monkeypatch):
    (tmp_path / "home" / "work").mkdir(parents=True)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path / "home" / "work")
    (tmp_path / "link").symlink_to(tmp_path / "home")
    for value in (tmp_path / "home", tmp_path, tmp_path / "link", "../work"):
        with pytest.raises(ScenarioError, match="working folder"):
            check_place("output", value)
    assert check_place("output", "../other") == Path("../other")


def test_a_users_folder_is_left_alone(tmp_path):
    thesis = tmp_path / "thesis"
    thesis.mkdir()
    (thesis / "chapter1.tex").write_text("x")
    (tmp_path / "link").symlink_to(thesis)
    (tmp_path / "file").write_text("x")
    before = tree(tmp_path)
    for kind in folders.KINDS:
        for path in (thesis, tmp_path / "link", tmp_path / "file", tmp_path / "file" / "x", Path("/dev/null/x")):
            with pytest.raises(ScenarioError, match=r"^output: [^\n]*$"):
                claim("output", path, kind)
    # Names alone make no run: neither config nor checkpoint of somebody else's.
    (thesis / "config.yaml").write_text("lr: 1\n")
    (thesis / "best.pt").write_bytes(b"")
    with pytest.raises(ScenarioError, match="none of ours"):
        refuse_foreign("run_dir", thesis, "run")
    assert tree(tmp_path) == sorted([*before, "thesis/best.pt", "thesis/config.yaml"])


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_an_unwritable_folder(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(ScenarioError, match="cannot be written"):
        refuse_foreign("run_dir", tmp_path / "run", "run")


def test_older_folders_are_recognised(tmp_path):
    run = old_run(tmp_path / "run")
    seed = tmp_path / "evaluation" / "greedy" / "seed_0"
    seed.mkdir(parents=True)
    (seed / "decisions.jsonl").touch()
    (tmp_path / "evaluation" / "summary.csv").touch()
    (tmp_path / "figures" / "cells").mkdir(parents=True)
    (tmp_path / "figures" / "cells" / "greedy_N5-0123456789ab.json").touch()
    (tmp_path / "data" / "part_0000").mkdir(parents=True)
    found = {name: kind_of(tmp_path / name) for name in ("run", "evaluation", "figures", "data")}
    assert found == {"run": "run", "evaluation": "evaluation", "figures": "cells", "data": "dataset"}
    for kind in ("evaluation", "cells", "dataset"):
        with pytest.raises(ScenarioError, match="is a training run, not"):
            claim("output", run, kind)
    (tmp_path / "evaluation" / "notes.txt").touch()
    assert kind_of(tmp_path / "evaluation") is None


def test_nothing_is_written_inside_a_run(tmp_path):
    run = old_run(tmp_path / "run")
    for path in (run / "table", run / "a" / "b", run / "x" / ".." / "y"):
        with pytest.raises(ScenarioError, match="lies inside the run"):
            claim("output", path, "evaluation")
    assert tree(run) == ["checkpoint_000000000064.pt", "config.yaml"]


def test_set_aside_takes_the_first_free_name_and_keeps_links(tmp_path):
    run = old_run(tmp_path / "disk" / "run")
    (tmp_path / "disk" / "run.1").symlink_to("nowhere")
    (tmp_path / "link").symlink_to(run)
    assert set_aside(tmp_path / "link") == tmp_path / "disk" / "run.2"
    assert (tmp_path / "link").is_symlink() and not run.exists()


def test_leftovers_of_killed_writes_are_removed_and_nothing_else(tmp_path):
    claim("output", tmp_path / "out", "evaluation").release()
    out, method = tmp_path / "out", tmp_path / "out" / "greedy"
    for folder in (".seed_0.17.partial", ".seed_0.17.old", ".seed_1.17.old", "seed_0"):
        (method / folder).mkdir(parents=True)
    (method / ".seed_1.17.old" / "metrics.json").touch()
    for name in (".checkpoint_000000000064.pt.17.partial", ".best.pt.17.partial", ".summary.csv.ab_cd123.tmp"):
        (out / name).touch()
    kept = [".notes.17.partial", ".thesis.tex.abcdefgh.tmp", "summary.csv.tmp", ".best.pt.bak"]
    for name in kept:
        (out / name).touch()
    (tmp_path / ".best.pt.17.partial").touch()
    claim("output", out, "evaluation").release()
    assert {path.name for path in out.iterdir()} == {MARKER, "greedy", *kept}
    assert tree(method) == ["seed_0", "seed_1", "seed_1/metrics.json"]  # seed_1 had been moved and not yet replaced
    assert (tmp_path / ".best.pt.17.partial").exists()


def test_an_output_file_of_somebody_else_is_kept(tmp_path):
    path = tmp_path / "new" / "table.csv"
    lock = claim_file("output", path, lambda file: False)
    with pytest.raises(ScenarioError, match="in use"):
        claim_file("output", path, lambda file: True)
    path.write_text("theirs")
    lock.release()
    assert tree(tmp_path) == ["new", "new/table.csv"]  # its lock is no litter
    with pytest.raises(ScenarioError, match="left alone"):
        claim_file("output", path, lambda file: file.read_text() == "ours")
    claim_file("output", path, lambda file: file.read_text() == "theirs").release()
    for wrong in (tmp_path, tmp_path / "new" / "table.csv" / "x"):
        with pytest.raises(ScenarioError, match=r"^output: "):
            claim_file("output", wrong, lambda file: True)


def test_held_locks_are_seen_without_taking_them(tmp_path):
    assert not locks.is_locked(tmp_path / "none")
