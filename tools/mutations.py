"""Ways to spoil a valid file, each reproducible by its random generator: bytes, lines, trees of values, tables of SQLite."""

from __future__ import annotations

import json
import re
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Spoil = Callable[[bytes, np.random.Generator], bytes]

LONG = b"9" * 6000
DEEP = 3000
TOKENS: tuple[bytes, ...] = (
    *(b"nan", b"inf", b"-inf", b"1e999990", b"-1e999990", b"1e308", b"-1e308", b"1e-320", b"0", b"-0", b"-1", b"1e-9"),
    *(b"1e9", b"1000000000", b"1e18", b"100000000.0", b"9223372036854775808", b"1180591620717411303424", LONG),
    *(b"1700000000000", b"1700000000000000000", b"2001-99-99", b"2001-01-01", b"0x7f", b"0o17", b"1_0"),
    *(b"true", b"null", b"~", b"", b"[1, 2]", b"{a: 1}", b"[]", b"'x'", b"!!python/object:os.system", b"*a", b"&a [*a]", b"<<"),
    *(b"$x$", b"$\\frac$", b"a/b", b"../../x", b"x" * 5000, b"\xff\xfe", b"\x00"),
    *("\N{ROBOT FACE}".encode(), "\N{RIGHT-TO-LEFT OVERRIDE}".encode(), "\N{ARABIC-INDIC DIGIT ONE}".encode()),
)
"""What a number or word may become."""

NUMBERS: tuple[bytes, ...] = (
    *(b"0", b"-0.0", b"1", b"-1", b"2", b"7", b"0.5", b"1e-9", b"1e-320", b"1000", b"1e6", b"1e8", b"-1e8", b"9.99e8", b"1e9"),
    *(b"1e12", b"1e18", b"1e300", b"-1e300", b"2147483648", b"9223372036854775807", b"1700000000", b"3.141592653589793"),
)
"""What a number may become that stays one."""

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 3.5, 1e9, -1e9, 10**9, 2**31, 2**63, 2**70, -(2**63)),
    *(1e308, 1e-320, float("nan"), float("inf")),
    *("", "x", "$x$", "$\\frac$", "nan", "../../x", "\ud800", "\x00", "a\nb", "x" * 5000),
    *([], [[]], {}, [1, 2, 3], ["x"], {"a": 1}, {"x": [None]}),
)
"""What a value of a tree or a cell of a table may become."""

WORDS: tuple[bytes, ...] = (
    *(struct.pack("<I", value) for value in (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x10000, 1_000_000_000)),
    *(struct.pack(">I", value) for value in (1, 0x7FFFFFFF, 0x10000, 0x40000000)),
    *(struct.pack("<d", value) for value in (np.nan, np.inf, 1e308, -1e308, 1e-320, 1e9, 1e18, 0.0)),
    *(struct.pack("<f", value) for value in (np.nan, np.inf, 3e38, -1.0, 0.0, 1e-40)),
    *(struct.pack("<Q", value) for value in (0, 2**63 - 1, 2**63, 2**64 - 1)),
)
"""What four or eight bytes may become."""

_NUMBER = re.compile(rb"(?<![\w.])-?\d+(\.\d+)?([eE][-+]?\d+)?(?![\w.])")
_TOKEN = re.compile(rb"[^\s,:\[\]{}\"]+")


def _some(rng: np.random.Generator, count: int) -> int:
    return int(rng.integers(max(count, 1)))


def flips(data: bytes, rng: np.random.Generator) -> bytes:
    """Some bits are turned."""
    spoilt = bytearray(data)
    for _ in range(int(rng.choice((1, 3, 30)))):
        if spoilt:
            spoilt[_some(rng, len(spoilt))] ^= 1 << _some(rng, 8)
    return bytes(spoilt)


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    """The end is missing."""
    return data[: _some(rng, len(data))]


def zeros(data: bytes, rng: np.random.Generator) -> bytes:
    """Zeros stand in the middle."""
    at, length = _some(rng, len(data)), int(rng.choice((4, 64, 4096)))
    return data[:at] + bytes(min(length, len(data) - at)) + data[at + length :]


def noise(data: bytes, rng: np.random.Generator) -> bytes:
    """Random bytes stand in the middle."""
    at, length = _some(rng, len(data)), int(rng.choice((1, 16, 256)))
    return data[:at] + rng.bytes(min(length, len(data) - at)) + data[at + length :]


def word(data: bytes, rng: np.random.Generator) -> bytes:
    """A number of four or eight bytes is another one: huge, tiny, negative, NaN."""
    new = WORDS[_some(rng, len(WORDS))]
    at = 4 * _some(rng, len(data) // 4) if rng.random() < 0.5 else _some(rng, min(len(data), 256))
    return data[:at] + new + data[at + len(new) :]


def moved(data: bytes, rng: np.random.Generator) -> bytes:
    """A piece is missing, or stands there twice."""
    at, length = _some(rng, len(data)), int(rng.choice((1, 8, 512)))
    return data[:at] + (data[at + length :] if rng.random() < 0.5 else data[at : at + length] + data[at:])


def token(data: bytes, rng: np.random.Generator) -> bytes:
    """A number or word is another one."""
    found = list(_TOKEN.finditer(data))
    if not found:
        return data
    for _ in range(int(rng.choice((1, 1, 4)))):
        match = found[_some(rng, len(found))]
        data = data[: match.start()] + TOKENS[_some(rng, len(TOKENS))] + data[match.end() :]
        found = list(_TOKEN.finditer(data))
    return data


def number(data: bytes, rng: np.random.Generator) -> bytes:
    """A number is another one, so that the file still reads as one of its kind; or all of its column are."""
    rows = data.splitlines()
    of_row = [list(_NUMBER.finditer(row)) for row in rows]
    holding = [k for k, found in enumerate(of_row) if found]
    if not holding:
        return data
    chosen = holding[_some(rng, len(holding))]
    at, new, scaled = _some(rng, len(of_row[chosen])), NUMBERS[_some(rng, len(NUMBERS))], rng.random() < 0.3
    factor = float(rng.choice((-1.0, 1e-3, 1e3, 1e6, 1e9, 1e12)))
    for k in holding if rng.random() < 0.2 else [chosen]:
        if at < len(of_row[k]):
            match = of_row[k][at]
            changed = repr(float(match[0]) * factor).encode() if scaled else new
            rows[k] = rows[k][: match.start()] + changed + rows[k][match.end() :]
    return b"\n".join(rows)


def column(data: bytes, rng: np.random.Generator) -> bytes:
    """The same field of every line is another one, or missing; or every number of a field is a thousand times larger."""
    lines = data.splitlines()
    width = max((len(line.split()) for line in lines), default=1)
    at, new = _some(rng, width), TOKENS[_some(rng, len(TOKENS))]
    longer = rng.random() < 0.4
    separator = b"," if b"," in data else b" "
    for number, line in enumerate(lines):
        fields = line.split(separator)
        if at < len(fields):
            fields[at] = fields[at] + b"000" if longer else new
            lines[number] = separator.join(fields)
    return b"\n".join(lines)


def lines(data: bytes, rng: np.random.Generator) -> bytes:
    """A line is missing, twice there, at another place, or a field of it is missing."""
    found = data.splitlines()
    if not found:
        return data
    one, other = _some(rng, len(found)), _some(rng, len(found))
    how = _some(rng, 4)
    if how == 0:
        del found[one]
    elif how == 1:
        found.insert(other, found[one])
    elif how == 2:
        found[one], found[other] = found[other], found[one]
    else:
        fields = found[one].split(b" ")
        del fields[_some(rng, len(fields))]
        found[one] = b" ".join(fields)
    return b"\n".join(found)


def nested(data: bytes, rng: np.random.Generator) -> bytes:
    """A value is nested thousands deep."""
    opening, closing_ = [(b"[", b"]"), (b"{a: ", b"}"), (b'{"a":', b"}"), (b"- ", b"")][_some(rng, 4)]
    deep = opening * DEEP + b"1" + (closing_ * DEEP if rng.random() < 0.7 else b"")
    found = list(_TOKEN.finditer(data))
    if not found or rng.random() < 0.2:
        return deep
    match = found[_some(rng, len(found))]
    return data[: match.start()] + deep + data[match.end() :]


def empty(_data: bytes, _rng: np.random.Generator) -> bytes:
    """Nothing is left."""
    return b""


BINARY: tuple[Spoil, ...] = (flips, flips, cut, zeros, noise, word, word, moved)
TEXT: tuple[Spoil, ...] = (*(number,) * 10, token, token, token, column, lines, lines, flips, cut, zeros, nested, noise, empty)


def as_json(data: bytes, rng: np.random.Generator) -> bytes:
    """A value of a JSON text is of another kind or missing."""
    return json.dumps(tree(json.loads(data), rng)).encode("utf-8", "surrogatepass")


def as_yaml(data: bytes, rng: np.random.Generator) -> bytes:
    """A value of a YAML text is of another kind or missing."""
    return str(yaml.safe_dump(tree(yaml.safe_load(data), rng), sort_keys=False)).encode("utf-8", "surrogatepass")


def tree(value: Any, rng: np.random.Generator) -> Any:
    """A tree of lists and mappings, one value of which is another one, is missing, or has another name."""
    while True:
        inner = list(value.items()) if isinstance(value, dict) else list(enumerate(value)) if isinstance(value, list) else []
        if not inner or rng.random() < 0.15:
            return VALUES[_some(rng, len(VALUES))]
        key, held = inner[_some(rng, len(inner))]
        if isinstance(held, dict | list) and held and rng.random() < 0.85:
            changed = tree(held, rng)
        else:
            changed = _alike(held, rng) if rng.random() < 0.6 else VALUES[_some(rng, len(VALUES))]
        how = rng.random()
        if how < 0.15:
            return type(value)(pair for pair in inner if pair[0] != key) if isinstance(value, dict) else value[:key]
        if isinstance(value, dict):
            name = "x" if how < 0.2 else key
            return {name if each == key else each: changed if each == key else old for each, old in inner}
        return [changed if each == key else old for each, old in inner]


def _alike(value: Any, rng: np.random.Generator) -> Any:
    """Another value of the same kind, so that it may well be allowed: numbers as small and as large as they come."""
    if isinstance(value, bool) or value is None:
        return not value
    if isinstance(value, int):
        return int(rng.choice((0, 1, 2, 3, 4, 7, 16, 80, 1000, 16_384, 10**6, -1))) if rng.random() < 0.7 else 10 * value
    if isinstance(value, float):
        return float(rng.choice((0.0, 1e-6, 1e-3, 0.5, 1.0, 10.0, 100.0, 1e3, 1e4, -1.0))) if rng.random() < 0.7 else -value
    return value


def table(path: Path, rng: np.random.Generator) -> None:
    """A cell, some rows or a table of an SQLite file are others or missing."""
    with closing(sqlite3.connect(path)) as connection:
        connection.text_factory = bytes
        names = [
            row[0].decode() for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")
        ]
        name = names[_some(rng, len(names))]
        how = rng.random()
        if how < 0.04:
            connection.execute(f"DROP TABLE {name}")
        elif how < 0.1:
            connection.execute(f"DELETE FROM {name}")
        elif how < 0.14:
            connection.execute(f"PRAGMA user_version = {int(rng.choice((0, 1, 2, 5, 1000)))}")
        elif how < 0.3:
            _rows(connection, name, rng)
        else:
            _cell(connection, name, rng, everywhere=bool(rng.random() < 0.15))
        connection.commit()


def _rows(connection: sqlite3.Connection, name: str, rng: np.random.Generator) -> None:
    """One row, or all from one on, are missing."""
    first = connection.execute(f"PRAGMA table_info({name})").fetchone()[1].decode()
    found = [row[0] for row in connection.execute(f"SELECT {first} FROM {name}")]
    if found:
        comparison = "=" if rng.random() < 0.7 else ">="
        connection.execute(f"DELETE FROM {name} WHERE {first} {comparison} ?", (found[_some(rng, len(found))],))


def _cell(connection: sqlite3.Connection, name: str, rng: np.random.Generator, *, everywhere: bool) -> None:
    columns = [row[1].decode() for row in connection.execute(f"PRAGMA table_info({name})")]
    column_, first = columns[_some(rng, len(columns))], columns[0]
    rows = connection.execute(f"SELECT {first}, {column_} FROM {name}").fetchall()
    if not rows:
        return
    key, old = rows[_some(rng, len(rows))]
    where, values = ("", ()) if everywhere else (f" WHERE {first} = ?", (key,))
    try:
        connection.execute(f"UPDATE OR REPLACE {name} SET {column_} = ?{where}", (_other(old, rng), *values))
    except (sqlite3.Error, OverflowError, UnicodeEncodeError):
        connection.rollback()  # the table does not take such a value


def _other(old: Any, rng: np.random.Generator) -> Any:
    if isinstance(old, bytes) and rng.random() < 0.75:
        try:
            return as_json(old, rng).decode("utf-8", "ignore")
        except ValueError:
            return BINARY[_some(rng, len(BINARY))](old, rng)
    new = VALUES[_some(rng, len(VALUES))]
    return json.dumps(new) if isinstance(new, list | dict) else str(new) if isinstance(new, str) else new
