"""Types that say which values they take, and the parser of dataclasses annotated with them.

A field or an argument is annotated with a plain type (``int``, ``str | None``, ``tuple[float, float]``, another
dataclass, ...) or with one of the types below, such as ``Count``, an integer of at least 1. The same annotation says
what is accepted and how a refusal is worded: ``KEY: VALUE where an integer of at least 1 was expected``.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import difflib
import os
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NoReturn, Union, get_args, get_origin

import numpy as np

from nfv_torchrl.errors import ScenarioError

RENAMED = {"checkpoint": "saving", "start": "init_from", "jobs": "parallel.jobs", "threads": "parallel.jobs"}
"""Settings that had another name in an earlier version."""
LONGEST_SHOWN = 100
PLAIN = {bool: "true or false", str: "text", int: "an integer", float: "a finite number"}


class Rule:
    """What an annotation adds to a plain type."""

    def describe(self, kind: str) -> str:
        """The description of the plain type, with this rule."""
        return kind

    def allows(self, value: Any) -> bool:
        """Whether a value of the plain type passes; it is seen as it was given."""
        raise NotImplementedError

    def check(self, value: Any, where: str, expected: str) -> None:
        """Refuse what is not allowed."""
        if not self.allows(value):
            refuse(where, value, expected)


@dataclass(frozen=True)
class Bounds(Rule):
    """An interval of numbers."""

    at_least: float | None = None
    above: float | None = None
    at_most: float | None = None

    def describe(self, kind: str) -> str:
        """See ``Rule``."""
        if self.above is not None:
            return f"{kind} above {self.above:,}" + ("" if self.at_most is None else f", at most {self.at_most:,}")
        if self.at_most is None:
            return f"{kind} of at least {self.at_least:,}"
        return f"{kind} from {self.at_least:,} to {self.at_most:,}"

    def allows(self, value: Any) -> bool:
        """See ``Rule``."""
        return (
            (self.at_least is None or value >= self.at_least)
            and (self.above is None or value > self.above)
            and (self.at_most is None or value <= self.at_most)
        )


class Exact(Rule):
    """No float that happens to be whole: a count written ``4.0`` is more likely a slip than meant."""

    def allows(self, value: Any) -> bool:
        """See ``Rule``."""
        return not isinstance(value, float | np.floating)


class OneOf(Rule):
    """A text out of a list."""

    def __init__(self, *choices: str) -> None:
        self.choices = choices

    def describe(self, kind: str) -> str:
        """See ``Rule``."""
        return f"one of {', '.join(self.choices)}"

    def allows(self, value: Any) -> bool:
        """See ``Rule``."""
        return value in self.choices


class NotEmpty(Rule):
    """A list with at least one entry."""

    def describe(self, kind: str) -> str:
        """See ``Rule``."""
        return f"{kind}, at least one"

    def allows(self, value: Any) -> bool:
        """See ``Rule``."""
        return bool(value)


class Seeds(Rule):
    """See ``list_of_seeds``."""

    def describe(self, kind: str) -> str:
        """See ``Rule``."""
        return f"a number of seeds from 1 to {MOST_SEEDS:,}, or a list of different integers of at least 0"

    def check(self, value: Any, where: str, expected: str) -> None:
        """See ``Rule``."""
        list_of_seeds(where, value)


LARGEST = 10**12
MOST_SEEDS = 100_000
Count = Annotated[int, Exact(), Bounds(at_least=1, at_most=LARGEST)]
Natural = Annotated[int, Exact(), Bounds(at_least=0, at_most=LARGEST)]
Threads = Annotated[int, Exact(), Bounds(at_least=1, at_most=1024)]
"""Or processes."""
Width = Annotated[int, Exact(), Bounds(at_least=1, at_most=2**16)]
"""Neurons of a layer."""
Widths = Annotated[Sequence[Width], NotEmpty()]
Tasks = Annotated[int, Exact(), Bounds(at_least=1, at_most=10_000)]
"""Horizons that are drawn before any is played."""
Seed = Annotated[int, Exact(), Bounds(at_least=0, at_most=2**32 - 1)]
"""What NumPy and torch both take."""
SeedList = Annotated[Any, Seeds()]
Positive = Annotated[float, Bounds(above=0)]
NotNegative = Annotated[float, Bounds(at_least=0)]
Share = Annotated[float, Bounds(at_least=0, at_most=1)]
LearningRate = Annotated[float, Bounds(above=0, at_most=1e30)]
"""Adam starts with ten times as much, which has to be a float32."""
StepSize = Annotated[float, Bounds(above=0, at_most=1)]
AboveOne = Annotated[float, Bounds(above=1)]
AtLeastOne = Annotated[float, Bounds(at_least=1)]
Quantiles = Annotated[int, Exact(), Bounds(at_least=2, at_most=2**16)]
Neurons = Annotated[int, Exact(), Bounds(at_least=0, at_most=2**16)]
"""Of a hidden layer that may be left out."""
Distance = Annotated[str, OneOf("l2", "l1", "smooth_l1")]
"""How far a value is from its target."""
StopKey = Annotated[str, OneOf("request_done", "done", "terminated")]
"""Where looking ahead ends."""
Activation = Annotated[
    str, OneOf("ReLU", "Tanh", "ELU", "GELU", "SiLU", "Mish", "LeakyReLU", "SELU", "CELU", "Softplus", "Sigmoid")
]


def list_of_seeds(key: str, seeds: Any) -> list[int]:
    """Workload seeds from a number of them (3: 0, 1 and 2) or a list.

    Raises:
        ScenarioError: neither a number from 1 to ``MOST_SEEDS`` nor a list of different integers of at least 0.
    """
    if _is_whole(seeds) and 0 < seeds <= MOST_SEEDS:
        return list(range(seeds))
    whole = isinstance(seeds, list | tuple) and all(_is_whole(seed) and seed >= 0 for seed in seeds)
    if not whole or not 0 < len(seeds) <= MOST_SEEDS or len(set(seeds)) < len(seeds):
        refuse(key, seeds, describe(SeedList))
    return list(seeds)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def parse_dataclass(kind: type, values: Any, where: str) -> Any:
    """An instance of the dataclass ``kind``; ``where`` is the key that the values stand under, empty at the root.

    Raises:
        ScenarioError: an unknown or missing key, or a value of the wrong kind or out of range.
    """
    if isinstance(values, kind):
        return values
    if not isinstance(values, Mapping):
        refuse(where or "the settings", values, "a mapping of keys to values")
    hints = typing.get_type_hints(kind, include_extras=True)
    for key in values:
        if key not in hints:
            refuse_key(join(where, key), hints)
    for spec in dataclasses.fields(kind):
        required = spec.default is dataclasses.MISSING and spec.default_factory is dataclasses.MISSING
        if required and spec.name not in values:
            raise ScenarioError(f"{join(where, spec.name)}: is missing; add it")
    return kind(**{key: parse(value, hints[key], join(where, key)) for key, value in values.items()})


def parse(value: Any, hint: Any, where: str, expected: str | None = None) -> Any:
    """``value`` as the annotated type ``hint``, or an error that says what was ``expected``."""
    expected = expected or describe(hint)
    if get_origin(hint) is Annotated:
        plain, *rules = get_args(hint)
        parsed = parse(value, plain, where, expected)
        for rule in rules:
            rule.check(value, where, expected)
        return parsed
    if get_origin(hint) in (Union, types.UnionType):
        return _parse_union(value, get_args(hint), where, expected)
    if dataclasses.is_dataclass(hint):
        return parse_dataclass(typing.cast(type, hint), value, where)
    if get_origin(hint) is dict or hint is dict:
        return _parse_mapping(value, (get_args(hint) or (str, Any))[1], where, expected)
    if get_origin(hint) in (tuple, list, collections.abc.Sequence):
        return _parse_sequence(value, hint, where, expected)
    if hint is Any or (isinstance(hint, type) and hint not in (int, float) and isinstance(value, hint)):
        return value
    if hint is str and isinstance(value, os.PathLike):
        return os.fspath(value)
    if hint in (int, float):
        return _parse_number(value, hint, where, expected)
    return refuse(where, value, expected)


def describe(hint: Any) -> str:
    """What a type takes, as ``... was expected`` puts it."""
    if get_origin(hint) is Annotated:
        plain, *rules = get_args(hint)
        text = describe(plain)
        for rule in rules:
            text = rule.describe(text)
        return text
    if get_origin(hint) in (Union, types.UnionType):
        return ", or ".join(describe(choice) for choice in get_args(hint))
    if hint is type(None):
        return "null"
    if dataclasses.is_dataclass(hint) or get_origin(hint) is dict or hint is dict:
        return "a mapping of keys to values"
    if get_origin(hint) in (tuple, list, collections.abc.Sequence):
        items = get_args(hint)
        if get_origin(hint) is tuple and items[-1] is not Ellipsis:
            return "two numbers [low, high]"
        return "a list" if items[0] is Any else f"a list whose entries are each {describe(items[0])}"
    if get_origin(hint) is os.PathLike:
        return "a path"
    return PLAIN.get(hint, f"a {getattr(hint, '__name__', hint)}")


def refuse(where: str, value: Any, expected: str) -> NoReturn:
    """Say what was expected instead of ``value``.

    Raises:
        ScenarioError: always.
    """
    raise ScenarioError(f"{where}: {shown(value)} where {expected} was expected")


def refuse_key(name: str, known: Iterable[str]) -> NoReturn:
    """Say that there is no key ``name`` (dotted), whose last part is none of ``known``.

    Raises:
        ScenarioError: always.
    """
    names = [str(key) for key in known]
    renamed = RENAMED.get(name, "")
    if renamed.partition(".")[0] in names:
        raise ScenarioError(f"{name}: was renamed to {renamed}; use that")
    close = difflib.get_close_matches(name.rpartition(".")[2], names, n=1)
    guess = f"did you mean {close[0]!r}? " if close else ""
    raise ScenarioError(f"{name}: unknown key; {guess}known keys: {', '.join(names) or 'none'}")


def shown(value: Any) -> str:
    """A value as a message shows it: short, and on one line."""
    try:
        text = repr(value)
    except ValueError:  # Python prints no integer of more than 4300 digits
        return "a number of thousands of digits"
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."


def join(where: str, key: Any) -> str:
    """The dotted name of a key; one that is long or not printable as ``shown`` has it."""
    text = str(key)
    name = text if len(text) <= LONGEST_SHOWN and text.isprintable() else shown(text)
    return f"{where}.{name}" if where else name


def _parse_union(value: Any, choices: Sequence[Any], where: str, expected: str) -> Any:
    if value is None and type(None) in choices:
        return None
    inner = [choice for choice in choices if choice is not type(None)]
    if len(inner) == 1:
        return parse(value, inner[0], where, None if dataclasses.is_dataclass(inner[0]) else expected)
    for choice in inner:
        try:
            return parse(value, choice, where)
        except ScenarioError:
            continue
    return refuse(where, value, expected)


def _parse_mapping(value: Any, hint: Any, where: str, expected: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        refuse(where, value, expected)
    return {str(key): parse(item, hint, join(where, key)) for key, item in value.items()}


def _parse_sequence(value: Any, hint: Any, where: str, expected: str) -> tuple[Any, ...]:
    hints = get_args(hint)
    endless = get_origin(hint) is not tuple or hints[-1] is Ellipsis
    if isinstance(value, str) or not isinstance(value, Sequence) or not (endless or len(value) == len(hints)):
        refuse(where, value, expected)
    return tuple(parse(item, hints[0], f"{where}[{place}]") for place, item in enumerate(value))


def _parse_number(value: Any, hint: Any, where: str, expected: str) -> int | float:
    if isinstance(value, np.generic):
        value = value.item()  # a float32 would overflow in the comparison
    # A comparison, because math.isfinite chokes on integers beyond a float's range.
    if isinstance(value, bool) or not isinstance(value, int | float) or not -1e300 < value < 1e300:
        refuse(where, value, expected)
    if hint is int and value != round(value):
        refuse(where, value, expected)
    return hint(value)
