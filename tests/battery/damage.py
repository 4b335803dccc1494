"""Ways to damage bytes, numbers and structures, all from a seeded generator."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable
from typing import Any

#: numbers at which programs break
EDGES: tuple[Any, ...] = (
    0, -0.0, 1, -1, 2, 90, 180, 360, 1e-9, 1e-300, 5e-324, 1e9, 1e300, -1e300, 2**31 - 1, 2**31,
    2**32, 2**53 + 1, 2**63, 10**400, 0.1, 511.5, 512, 765, 1100, 4096, 4097, True, False, None,
    "", "1", "NaN", "0x10", "a" * 300, "\u202e", "\x00", "é", [], {}, [1], [[]], [0, 0], [1, 1, 1],
    [None] * 3, {"a": 1}, [True, True], ["1", "2"],
)  # fmt: skip
TOKENS = (
    b"NaN", b"Infinity", b"-Infinity", b"1e999", b"1" * 5000, b"true", b"null", b'"', b"\\u0000",
    b"\\ud800", b"{", b"}", b"[", b"]", b"," * 9, b"\xff\xfe", b"\xef\xbb\xbf", b"[" * 5000,
    b'{"a":' * 900, b"//", b"'", b"\x00", b"-", b"1.", b".5", b"+1", b"0123",
)  # fmt: skip


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Apply one to four changes to bytes: flips, cuts, repeats, edge values, noise."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        if not out:
            break
        at = rng.randrange(len(out))
        kind = rng.randrange(8)
        if kind == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            out[at] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
        elif kind == 2:
            del out[at : at + rng.choice((1, 2, 4, 100))]
        elif kind == 3:
            out[at:at] = out[max(0, at - rng.choice((1, 4, 50))) : at]
        elif kind == 4:
            del out[at:]
        elif kind == 5:
            out[at : at + 4] = rng.choice((b"\xff" * 4, b"\x00" * 4, b"\x7f\xff\xff\xff"))
        elif kind == 6:
            out[at:at] = rng.randbytes(rng.choice((1, 3, 30)))
        else:
            other = rng.randrange(len(out))
            out[at : at + 8], out[other : other + 8] = out[other : other + 8], out[at : at + 8]
    return bytes(out)


def changed(value: Any, rng: random.Random) -> Any:
    """Return a copy of a JSON value with one to three places changed."""
    out = copy.deepcopy(value)
    for _ in range(rng.randint(1, 3)):
        places = list(_places(out))
        if not places:
            break
        holder, key = rng.choice(places)
        _change(holder, key, rng)
    return out


def _places(value: Any) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    stack = [value]
    while stack:
        holder = stack.pop()
        keys = holder if isinstance(holder, dict) else range(len(holder))
        for key in list(keys):
            found.append((holder, key))
            if isinstance(holder[key], (dict, list)):
                stack.append(holder[key])
    return found


def _change(holder: Any, key: Any, rng: random.Random) -> None:
    actions: list[Callable[[], None]] = [
        lambda: holder.__setitem__(key, copy.deepcopy(rng.choice(EDGES))),
        lambda: holder.__delitem__(key),
    ]
    value = holder[key]
    if isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e200:
        factor = rng.choice((-1, 0, 0.1, 1e-3, 10, 1e3, 0.5, 2, 1 + 1e-12))
        actions += [lambda: holder.__setitem__(key, value * factor)] * 3
    if isinstance(holder, dict):
        actions.append(lambda: holder.__setitem__(str(key) + rng.choice("s_ x"), value))
    else:
        actions.append(lambda: holder.insert(key, copy.deepcopy(value)))
    rng.choice(actions)()
