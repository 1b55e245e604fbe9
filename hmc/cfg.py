"""Experiment files: TOML in, frozen dataclasses out, and every mistake in a file named.

The dataclass lives next to its owner and says what may be set, of which type and with which default; a
file holds values only. Fields may be bool, int, float, str, Literal, a nested dataclass, ``X | None``
(absent means None), ``tuple[X, ...]`` or ``tuple[X, Y]``. An int is fine where a float is expected. A
table changes the default of its field key by key.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


class CfgError(ValueError):
    """A config that cannot be used; the message says where, what was expected and what came."""


def load(path: str | Path, cls: type[T], overrides: Sequence[str] = (), *, table: str = "") -> T:
    """Read a TOML file, or one table of it, into the dataclass `cls`; `overrides` as in `override`."""
    path = Path(path)
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        here = ", ".join(sorted(p.name for p in path.parent.glob("*.toml"))) or "none"
        raise CfgError(f"{path}: no such file; config files in {path.parent}: {here}") from None
    except tomllib.TOMLDecodeError as error:
        at = re.search(r"line (\d+)", str(error))
        line = at[1] if at else len(path.read_text(encoding="utf-8").splitlines())  # it ends too early
        raise CfgError(f"{path}:{line}: not valid TOML: {error}") from None
    except UnicodeDecodeError as error:
        raise CfgError(f"{path}: not a text file in UTF-8: {error}") from None
    if table and not isinstance(found.get(table), dict):
        raise CfgError(f"{path}: has no table [{table}]; it has {', '.join(found) or 'nothing'}")
    found = found[table] if table else found
    return _build(_set(found, overrides), cls, " with ".join([str(path), *overrides]), "")


def override(cfg: T, items: Sequence[str]) -> T:
    """A copy of `cfg` with values set as on a command line: ``override(cfg, ["ppo.lr=1e-4"])``.

    A value is written as in TOML; what is not valid TOML is taken as a string, so that ``engine=warp``
    needs no quotes.
    """
    return _build(_set({}, items), type(cfg), "override " + " ".join(items), "", cfg)


def dump(cfg: Any) -> str:
    """Canonical TOML text: every value by its full key, one a line, sorted. `load` of it gives `cfg`."""
    typed = _build(_table(cfg), type(cfg), type(cfg).__name__, "")  # an int is a float now where it must be
    if typed != cfg:
        raise TypeError(f"{cfg}: TOML cannot say None: a field that can be None must default to it")
    return "".join(f"{key} = {value}\n" for key, value in sorted(_lines(_table(typed), "")))


def digest(cfg: Any) -> str:
    """SHA-256 of the canonical text, in hex: equal for equal values, on any machine."""
    return hashlib.sha256(dump(cfg).encode()).hexdigest()


def _set(table: dict[str, Any], items: Sequence[str]) -> dict[str, Any]:
    """Write ``key=value`` items into a table, which it returns."""
    for item in items:
        key, equals, text = item.partition("=")
        *tables, leaf = key.strip().split(".")
        if not equals or not leaf:
            raise CfgError(f"override {item!r}: expected key=value, such as ppo.lr=1e-4")
        inner: Any = table
        for name in tables:
            inner = inner.setdefault(name, {})
            if not isinstance(inner, dict):
                raise CfgError(f"override {item!r}: {name} is a value, it has no key {leaf}")
        inner[leaf] = _parse(text.strip())
    return table


def _build(table: dict[str, Any], cls: Any, source: str, prefix: str, base: Any = None) -> Any:
    """One table into one dataclass; what it leaves out is as in `base`, or else the class's default."""
    known = _fields(cls)
    for key in table:
        if key not in known:
            hint = f"{_near(key, known)}; known: {', '.join(known)}"
            raise CfgError(f"{source}: unknown key {prefix}{key}{hint}")
    values = {}
    for key, (default, kind) in known.items():
        if base is not None:
            default = getattr(base, key)
        if key in table:
            values[key] = _convert(table[key], kind, source, prefix + key, default)
        elif default is not MISSING:
            values[key] = default
        elif is_dataclass(kind):
            values[key] = _build({}, kind, source, f"{prefix}{key}.")  # names the keys that it lacks
        elif _unwrap(kind)[1]:
            values[key] = None
        else:
            raise CfgError(f"{source}: missing {prefix}{key}, expected {_describe(kind)}")
    try:
        return cls(**values)
    except ValueError as error:  # what the owner checks in __post_init__
        raise CfgError(f"{source}: {prefix.rstrip('.') or cls.__name__}: {error}") from error


def _convert(value: Any, kind: Any, source: str, key: str, default: Any = None) -> Any:
    """One value of the file as a value of type `kind`."""
    kind, _ = _unwrap(kind)
    origin, args = get_origin(kind), get_args(kind)
    if is_dataclass(kind) and isinstance(value, dict):
        return _build(value, kind, source, key + ".", default if type(default) is kind else None)
    if origin is Literal and any(type(value) is type(arg) and value == arg for arg in args):
        return value
    if origin is tuple and isinstance(value, list):
        kinds = [args[0]] * len(value) if args[-1] is ... else args
        if len(kinds) == len(value):
            pairs = enumerate(zip(value, kinds, strict=True))
            return tuple(_convert(v, k, source, f"{key}[{i}]") for i, (v, k) in pairs)
    if kind is float and type(value) is int and abs(value) <= 2**53:
        return float(value)
    if kind in (bool, int, float, str) and type(value) is kind and value == value:  # not nan
        return value
    hint = _near(str(value), args) if origin is Literal else ""
    got = f"{_describe(type(value))} {json.dumps(value, ensure_ascii=False, default=str)}"
    raise CfgError(f"{source}: {key}: expected {_describe(kind)}, got {got}{hint}")


def _table(cfg: Any) -> Any:
    """A dataclass as the table that TOML would give for it; anything else as it would be there."""
    if isinstance(cfg, tuple):
        return [_table(value) for value in cfg]
    if not is_dataclass(cfg):
        return cfg
    values = {name: getattr(cfg, name) for name in _fields(type(cfg))}
    return {name: _table(value) for name, value in values.items() if value is not None}


def _lines(table: dict[str, Any], prefix: str) -> Iterator[tuple[str, str]]:
    """Full key and TOML value of everything in a table."""
    for name, value in table.items():
        inner = isinstance(value, dict) and value
        yield from _lines(value, f"{prefix}{name}.") if inner else [(prefix + name, _toml(value))]


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {v}" for k, v in sorted(_lines(value, ""))) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, str | bool):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value + 0)  # -0.0 becomes 0.0


def _parse(text: str) -> Any:
    with suppress(tomllib.TOMLDecodeError):
        if len(parsed := tomllib.loads(f"value = {text}")) == 1:
            return parsed["value"]
    return text


def _fields(cls: Any) -> dict[str, tuple[Any, Any]]:
    """Name -> default (or MISSING) and type, for what the constructor takes."""
    kinds = get_type_hints(cls)
    made = {f.name: f.default_factory() for f in fields(cls) if f.default_factory is not MISSING}
    return {f.name: (made.get(f.name, f.default), kinds[f.name]) for f in fields(cls) if f.init}


def _unwrap(kind: Any) -> tuple[Any, bool]:
    """``X | None`` as (X, True), any other type as (itself, False)."""
    args = get_args(kind)
    if get_origin(kind) in (Union, UnionType) and len(args) == 2 and NoneType in args:
        return args[args[0] is NoneType], True
    return kind, False


def _describe(kind: Any) -> str:
    """A type in the words of a config file."""
    if is_dataclass(kind):
        return "table of " + ", ".join(_fields(kind))
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(map(_toml, get_args(kind)))
    if get_origin(kind) is tuple:
        kinds = [_describe(arg) for arg in get_args(kind) if arg is not ...]
        return f"list of {kinds[0]}" if ... in get_args(kind) else f"list [{', '.join(kinds)}]"
    return {dict: "table"}.get(kind, getattr(kind, "__name__", str(kind)))


def _near(name: str, known: Iterable[Any]) -> str:
    """The end of a message: what may have been meant."""
    near = difflib.get_close_matches(name, map(str, known), 3)
    return f"; did you mean {' or '.join(near)}?" if near else ""
