"""What services and VNFs may be called, so that every file, table and tag that names them can be read back."""

from __future__ import annotations

from typing import Any

from nfv_torchrl.errors import ScenarioError
from nfv_torchrl.settings.values import shown

LONGEST_NAME = 100


def check_name(name: Any, where: str) -> None:
    """Refuse what is no name: text of 1 to 100 printable characters without blanks around it and without ``/``.

    CSV files are read with blanks around a name dropped, a line break would end a table's row, and ``/`` separates the
    parts of a metric's name (``aar/web``) and of a TensorBoard tag. YAML reads a bare ``no``, ``off``, ``yes`` or
    ``on`` as true or false.

    Raises:
        ScenarioError: ``name`` is not of that form; the message begins with ``where``.
    """
    if not isinstance(name, str):
        hint = " (YAML reads bare no, off, yes and on so)" if isinstance(name, bool) else ""
        raise ScenarioError(f"{where}: {shown(name)} is no name{hint}; a name is text, put it in quotes")
    if not name.strip():
        raise ScenarioError(f"{where}: {name!r} is an empty name; give it one")
    if name != name.strip():
        raise ScenarioError(f"{where}: the name {name!r} has blanks around it; remove them")
    if len(name) > LONGEST_NAME:
        raise ScenarioError(
            f"{where}: the name {name[:20]!r}... has {len(name)} characters; use at most {LONGEST_NAME}"
        )
    if "/" in name or not name.isprintable():
        raise ScenarioError(f"{where}: the name {name!r} has a '/' or a character that is not printable; remove it")
