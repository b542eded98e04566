"""What files that are read back must hold, told by types: one check for all of them, which names the first wrong entry.

A schema is a type: ``int``, ``float`` (a finite number), ``bool``, ``str``, ``None``, ``Any``, unions of these,
``list[T]``, ``tuple[T, ...]``, ``dict[str, T]``, a `typing.TypedDict`, and ``Annotated[T, Least(n)]``.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Mapping
from typing import Annotated, Any, NamedTuple, get_args, get_origin

from torchdyn_plan.errors import InputError, TorchdynPlanError


class Least(NamedTuple):
    """The number annotated is not below it."""

    value: float


Count = Annotated[int, Least(0)]
"""A whole number from 0."""
Positive = Annotated[int, Least(1)]
"""A whole number from 1."""


class MismatchError(ValueError):
    """An entry is not what the schema says."""


def check_content(
    content: Any, schema: Any, where: str, error: type[TorchdynPlanError] = InputError, *, entry: str = ""
) -> Any:
    """``content``, as it is, if it fits ``schema``.

    Args:
        content: values as JSON has them.
        schema: the type that it must be of.
        where: the file, for the message.
        error: what is raised, with the file, the first wrong entry, what it should be and what it is.
        entry: how the content is called there; empty for all of it.
    """
    try:
        _check(content, schema, entry)
    except MismatchError as mismatch:
        raise error(f"{where}: {mismatch}") from mismatch
    return content


def check_settings(settings: Any, kind: Any, where: str, error: type[TorchdynPlanError] = InputError) -> dict[str, Any]:
    """``settings``, if they are fields of the dataclass ``kind`` by name, each of its type; those left out are fine."""
    hints = typing.get_type_hints(kind)
    fields = {one.name: hints[one.name] for one in dataclasses.fields(kind) if one.init}
    check_content(settings, dict[str, Any], where, error)
    for name, value in settings.items():
        if name not in fields:
            raise error(f"{where}: unknown entry {name!r}, expected some of {', '.join(fields)}")
        check_content(value, fields[name], where, error, entry=name)
    return settings


def _check(value: Any, schema: Any, entry: str) -> None:
    """Raise `MismatchError` unless ``value``, called ``entry``, is of the type ``schema``."""
    origin, parts = get_origin(schema), get_args(schema)
    if schema is Any:
        return
    if typing.is_typeddict(schema):
        _check_fields(value, schema, entry)
    elif origin is Annotated:
        _check(value, parts[0], entry)
        for limit in parts[1:]:
            if isinstance(limit, Least) and value < limit.value:
                raise _mismatch(entry, f"a number >= {limit.value:g}", value)
    elif origin in (types.UnionType, typing.Union):
        if not any(_fits(value, part, entry) for part in parts):
            raise _mismatch(entry, " or ".join(map(_name, parts)), value)
    elif origin is dict:
        _of(value, Mapping, entry, "an object")
        for name, one in value.items():
            _check(one, parts[1], _below(entry, name))
    elif origin in (list, tuple):
        _check_list(value, parts, entry)
    else:
        _check_scalar(value, schema, entry)


def _check_fields(value: Any, schema: Any, entry: str) -> None:
    _of(value, Mapping, entry, "an object")
    for name, kind in typing.get_type_hints(schema, include_extras=True).items():
        if name in value:
            _check(value[name], kind, _below(entry, name))
        elif name in schema.__required_keys__:
            raise MismatchError(f"{_below(entry, name)} is missing")


def _check_list(value: Any, parts: tuple[Any, ...], entry: str) -> None:
    """A list of one type, or of a type for each place."""
    _of(value, list, entry, "a list")
    kinds = parts
    if len(parts) == 1 or parts[-1] is ...:
        kinds = (parts[0],) * len(value)
    if len(kinds) != len(value):
        raise _mismatch(entry, f"a list of {len(kinds)}", value)
    for index, (one, kind) in enumerate(zip(value, kinds, strict=True)):
        _check(one, kind, f"{entry}[{index}]")


def _check_scalar(value: Any, schema: Any, entry: str) -> None:
    fits: Callable[[Any], bool] = _SCALARS.get(schema, lambda one: isinstance(one, schema))
    if not fits(value):
        raise _mismatch(entry, _name(schema), value)


def _is_whole(value: Any) -> bool:
    """Whether it is a whole number; beyond 64 bits it is none that was ever written, and no tensor takes it."""
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63


_SCALARS: dict[Any, Callable[[Any], bool]] = {
    bool: lambda value: isinstance(value, bool),
    int: _is_whole,
    float: lambda value: _is_whole(value) or (isinstance(value, float) and math.isfinite(value)),
    str: lambda value: isinstance(value, str),
    None: lambda value: value is None,
    types.NoneType: lambda value: value is None,
}


def _fits(value: Any, schema: Any, entry: str) -> bool:
    try:
        _check(value, schema, entry)
    except MismatchError:
        return False
    return True


def _of(value: Any, kind: type, entry: str, expected: str) -> None:
    if not isinstance(value, kind):
        raise _mismatch(entry, expected, value)


def _mismatch(entry: str, expected: str, value: Any) -> MismatchError:
    shown = repr(value)
    shown = shown if len(shown) <= 60 else f"{shown[:57]}…"
    return MismatchError(f"{entry or 'the content'} must be {expected}, got {shown}")


def _below(entry: str, name: str) -> str:
    return f"{entry}.{name}" if entry else str(name)


def _name(schema: Any) -> str:
    words = {int: "a whole number", float: "a finite number", bool: "true or false", str: "a text", None: "null"}
    words[types.NoneType] = "null"
    return words.get(schema) or getattr(schema, "__name__", str(schema))
