"""What may go wrong in files: trees and bytes that are changed at random places."""

import copy
import datetime
from typing import Any

from hypothesis import strategies as st

HOSTILE = (
    *(float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 5e-324, 0.0, -1, 0, 3, 10**19),
    *(10**400, True, "", "nan", "1", "mass", "pinned", "\x00", "é" * 200, 10**6),
    *([], [[]], [1], [1, "a"], [[1], [1, 2]], [True], [1e308] * 4, [[[1]]], [{}], {}),
    *({"kind": "mass"}, {"kind": "lqr"}, {"kind": []}, {"cutoff": 1e300}),
    *(datetime.date(1979, 5, 27), datetime.time(7, 32)),
)
SNIPPETS = (
    *(b"\n", b"\r", b",", b";", b"\t", b'"', b"nan", b"1e999", b"-", b"[", b"\0", b"\xff"),
    *(b"\xc2\xb2", b"1_0", b"X_Value", b"Channels\n", b"***End_of_Header***\t\n", b"# "),
)


def _places(tree: Any, way: tuple = ()) -> list[tuple]:
    """The ways to everything in a tree of dictionaries and lists."""
    inner = tree.items() if isinstance(tree, dict) else enumerate(tree)
    found = []
    for key, value in inner:
        found.append((*way, key))
        if isinstance(value, dict | list):
            found += _places(value, (*way, key))
    return found


def _follow(tree: Any, way: tuple) -> Any:
    for key in way:
        tree = tree[key]
    return tree


@st.composite
def trees(draw, tree: dict) -> dict:
    """A tree with up to three entries replaced, removed, renamed, swapped or scaled."""
    tree = copy.deepcopy(tree)
    for _ in range(draw(st.integers(1, 3))):
        places = _places(tree)
        if not places:
            break
        *way, key = draw(st.sampled_from(places))
        parent = _follow(tree, way)
        what = draw(st.sampled_from(["replace", "remove", "rename", "swap", "scale"]))
        if what == "replace":
            parent[key] = copy.deepcopy(draw(st.sampled_from(HOSTILE)))
        elif what == "remove":
            del parent[key]
        elif what == "rename" and isinstance(parent, dict):
            parent[draw(st.text("abkinx_. ", max_size=6))] = parent.pop(key)
        elif what == "swap":
            parent[key] = copy.deepcopy(_follow(tree, draw(st.sampled_from(places))))
        elif isinstance(parent[key], float):
            parent[key] *= draw(st.sampled_from([-1.0, 1e-200, 1e200]))
    return tree


@st.composite
def contents(draw, content: bytes) -> bytes:
    """The bytes of a file with up to five places changed, removed, filled in or repeated."""
    changed = bytearray(content)
    for _ in range(draw(st.integers(1, 5))):
        if not changed:
            break
        # Most of what matters is at the beginning.
        reach = draw(st.sampled_from([60, 300, len(changed)]))
        place = draw(st.integers(0, min(reach, len(changed)) - 1))
        what = draw(st.sampled_from(["flip", "cut", "fill", "snippet", "repeat", "end"]))
        if what == "flip":
            changed[place] ^= 1 << draw(st.integers(0, 7))
        elif what == "cut":
            del changed[place : place + draw(st.integers(1, 50))]
        elif what == "fill":
            changed[place:place] = draw(st.binary(min_size=1, max_size=20))
        elif what == "snippet":
            changed[place:place] = draw(st.sampled_from(SNIPPETS))
        elif what == "repeat":
            changed[place:place] = changed[place // 2 : place // 2 + 40]
        else:
            del changed[place:]
    return bytes(changed)
