"""Damage to what was written: to bytes, to JSON, and to safetensors files."""

from __future__ import annotations

import copy
import json
import math
import struct
from random import Random
from typing import Any

STRANGE: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    2**70,
    -(10**30),
    1e308,
    -0.5,
    math.nan,
    math.inf,
    "",
    "x" * 500,
    "\0",
    "../../x",
    [],
    {},
    [None],
    [[[]]],
    {"": None},
)
"""Values that nobody wrote."""


def damaged_bytes(draw: Random, content: bytes) -> bytes:
    """``content`` cut short, longer, with other bytes somewhere, or something else altogether."""
    kind = draw.randrange(6)
    if kind == 0:
        return content[: draw.randrange(len(content))]
    if kind == 1:
        return content + draw.randbytes(draw.randrange(1, 200))
    if kind == 2:
        return draw.randbytes(draw.randrange(200))
    if kind == 3:
        begin = draw.randrange(len(content))
        return content[:begin] + content[begin + draw.randrange(1, 64) :]
    changed = bytearray(content)
    # Half of the flips are in the header, where the structure is.
    reach = len(changed) if kind == 4 else min(len(changed), 2000)
    for _ in range(draw.choice((1, 1, 8))):
        changed[draw.randrange(reach)] ^= 1 << draw.randrange(8)
    return bytes(changed)


def damaged_json(draw: Random, content: Any) -> Any:
    """``content`` with an entry somewhere removed, renamed, doubled, or of another kind."""
    content = copy.deepcopy(content)
    for _ in range(draw.choice((1, 1, 1, 3))):
        holder = draw.choice(_holders(content) or [None])
        if holder is None or draw.random() < 0.05:
            return copy.deepcopy(draw.choice(STRANGE))
        _change(draw, holder)
    return content


def _holders(content: Any) -> list[Any]:
    """Every object and list in ``content`` that is not empty; long lists count once, whatever is in them."""
    found = [content] if isinstance(content, (dict, list)) and content else []
    within = content.values() if isinstance(content, dict) else content[:3] if isinstance(content, list) else ()
    return found + [holder for one in within for holder in _holders(one)]


def _change(draw: Random, holder: Any) -> None:
    place = draw.choice(list(holder)) if isinstance(holder, dict) else draw.randrange(len(holder))
    kind = draw.randrange(5)
    if kind == 0:
        del holder[place]
    elif kind == 1 and isinstance(holder, dict):
        holder[f"{place}x"] = holder.pop(place)
    elif kind == 2 and isinstance(holder, list):
        holder.append(copy.deepcopy(holder[place]))
    elif kind == 3:
        holder[place] = _near(draw, holder[place])
    else:
        holder[place] = copy.deepcopy(draw.choice(STRANGE))


def _near(draw: Random, value: Any) -> Any:
    """Something like ``value``."""
    if isinstance(value, bool):
        return draw.choice((not value, int(value), str(value)))
    if isinstance(value, (int, float)):
        return draw.choice((value + 1, -value, value * 10**9, float(value), str(value)))
    if isinstance(value, str):
        return draw.choice((value[:-1], value + "x", value.upper(), [value]))
    return draw.choice(([value], {"0": value}, None))


def json_bytes(content: Any) -> bytes:
    """``content`` as people write it: with NaN and infinities."""
    return json.dumps(content, allow_nan=True).encode()


def with_header(file: bytes, change: Any) -> bytes:
    """A safetensors ``file`` whose header is what ``change`` makes of it."""
    (size,) = struct.unpack("<Q", file[:8])
    header = json_bytes(change(json.loads(file[8 : 8 + size])))
    return struct.pack("<Q", len(header)) + header + file[8 + size :]
