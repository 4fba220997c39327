"""Damage to bytes, text and nested values, drawn from a seeded generator."""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np
import torch

NUMBERS = [
    0, -1, 1, 2, 3, 0.5, -0.0, 1e-300, 1e300, math.nan, math.inf, -math.inf, 2**31, 2**31 - 1, 2**32, -(2**31), 2**63,
    2**63 - 1, 2**64, 10**18, 10**400, True, False,
]  # fmt: skip
WORDS = [
    "", " ", "null", "no", "nan", "-1", "1e999", "0x10", "../x", "/dev/zero", "a" * 5000, "ä\u2028\u0000",
    "${oc.env:HOME}", "${nothing}", "{}", "[1", "<x>", "&lt;", "1,2", "\ufeff", "none", "true", "web", "float('inf')",
]  # fmt: skip
TOKENS = [b"NaN", b"null", b"1e999", b"-1", b"1" + b"0" * 400, b"[" * 5000, b"{" * 50, b'"', b"\0", b"<", b">",
          b"\xff\xfe", b"\xef\xbb\xbf", b",", b"\n", b"-", b"&#0;", b"99999999999999999999", b"true"]  # fmt: skip


def bytes_of(rng: random.Random, data: bytes) -> bytes:
    """One to four changes of a file's bytes."""
    out = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 4])):
        at = rng.randrange(len(out) + 1)
        kind = rng.randrange(12)
        if kind == 0 and out:
            out[at % len(out)] = rng.randrange(256)
        elif kind == 1:
            del out[at:]
        elif kind == 2:
            del out[at : at + rng.randrange(1, 60)]
        elif kind == 3:
            out[at:at] = rng.choice(TOKENS)
        elif kind == 4:
            out[at : at + 8] = rng.choice(TOKENS)
        elif kind == 5:
            out[at:at] = out[at : at + rng.randrange(1, 300)]
        else:
            _replace_number(rng, out)
    if rng.random() < 0.05:
        return bytes(out).decode("utf-8", "ignore").encode(rng.choice(["utf-16", "latin-1", "utf-32"]), "replace")
    return bytes(out)


def _replace_number(rng: random.Random, out: bytearray) -> None:
    """A run of digits somewhere becomes another number."""
    at = next((k for k in range(rng.randrange(len(out) + 1), len(out)) if 48 <= out[k] <= 57), None)
    if at is not None:
        end = at
        while end < len(out) and (48 <= out[end] <= 57 or out[end] == 46):
            end += 1
        out[at:end] = str(rng.choice(NUMBERS)).encode() if rng.random() < 0.7 else rng.choice(TOKENS)


def value_of(rng: random.Random, value: Any) -> Any:
    """Something in place of a value: of the same kind, or of another."""
    if isinstance(value, torch.Tensor) and rng.random() < 0.85:
        return _tensor(rng, value)
    nested: Any = []
    for _ in range(rng.choice([2, 50, 400])):
        nested = [nested] if rng.random() < 0.5 else {"a": nested}
    return rng.choice([None, [], {}, nested, [value], {"x": value}, rng.choice(NUMBERS), rng.choice(NUMBERS),
                       rng.choice(NUMBERS), rng.choice(WORDS), rng.choice(WORDS), str(value)[:100]])  # fmt: skip


def _tensor(rng: random.Random, value: torch.Tensor) -> torch.Tensor:
    kind = rng.randrange(6)
    if kind == 0:
        return value.to(rng.choice([torch.float32, torch.int64, torch.bool, torch.int8, torch.float64]))
    if kind == 1:
        return value.reshape(-1)[: max(0, value.numel() - rng.randrange(3))]
    if kind == 2:
        return value[None]
    out = value.clone()
    if not out.numel() or out.dtype == torch.bool:
        return ~out if out.dtype == torch.bool else out
    flat = out.reshape(-1)
    for _ in range(rng.choice([1, 1, 5, flat.numel()])):
        at = rng.randrange(flat.numel())
        if out.dtype.is_floating_point:
            flat[at] = rng.choice([math.nan, math.inf, -1.0, 1e30, 0.5])
        else:
            info = torch.iinfo(out.dtype)
            flat[at] = rng.choice(
                [info.max, info.min, 0, -min(1, -info.min), int(flat[at]) + (int(flat[at]) < info.max), 1]
            )
    return out


def nested_of(rng: random.Random, document: Any, times: int = 2) -> Any:
    """A copy of nested dicts and lists with values, keys or entries changed at random places."""
    for _ in range(rng.randrange(1, times + 1)):
        document = _once(rng, document)
    return document


def _once(rng: random.Random, node: Any) -> Any:
    if isinstance(node, dict) and node and rng.random() < 0.93:
        key = rng.choice(list(node))
        kind = rng.random()
        if kind < 0.06:
            return {k: v for k, v in node.items() if k != key}
        if kind < 0.1:
            return node | {rng.choice([*WORDS, key + "x" if isinstance(key, str) else 7]): rng.choice(NUMBERS)}
        return node | {key: _once(rng, node[key])}
    if isinstance(node, list) and node and rng.random() < 0.93:
        at, kind = rng.randrange(len(node)), rng.random()
        if kind < 0.06:
            return node[:at] + node[at + 1 :]
        if kind < 0.12:
            return [*node, node[at]]
        return [*node[:at], _once(rng, node[at]), *node[at + 1 :]]
    return value_of(rng, node)


def array_of(rng: random.Random, array: np.ndarray) -> np.ndarray:
    """As ``value_of`` for an array, always an array."""
    return _tensor(rng, torch.from_numpy(array.copy())).numpy()
