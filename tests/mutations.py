"""Random damage to files: changed trees of dictionaries and lists, and changed bytes."""

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


def _paths(tree: Any, parent: tuple = ()) -> list[tuple]:
    """Paths (keys and indices) of all entries in a tree of dictionaries and lists."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree)
    paths = []
    for key, value in entries:
        paths.append((*parent, key))
        if isinstance(value, dict | list):
            paths += _paths(value, (*parent, key))
    return paths


def _entry(tree: Any, path: tuple) -> Any:
    """The entry at a path."""
    for key in path:
        tree = tree[key]
    return tree


@st.composite
def trees(draw, tree: dict) -> dict:
    """A tree with up to three entries replaced, removed, renamed, swapped or scaled."""
    tree = copy.deepcopy(tree)
    for _ in range(draw(st.integers(1, 3))):
        paths = _paths(tree)
        if not paths:
            break
        *path, key = draw(st.sampled_from(paths))
        parent = _entry(tree, path)
        change = draw(st.sampled_from(["replace", "remove", "rename", "swap", "scale"]))
        if change == "replace":
            parent[key] = copy.deepcopy(draw(st.sampled_from(HOSTILE)))
        elif change == "remove":
            del parent[key]
        elif change == "rename" and isinstance(parent, dict):
            parent[draw(st.text("abkinx_. ", max_size=6))] = parent.pop(key)
        elif change == "swap":
            parent[key] = copy.deepcopy(_entry(tree, draw(st.sampled_from(paths))))
        elif isinstance(parent[key], float):
            parent[key] *= draw(st.sampled_from([-1.0, 1e-200, 1e200]))
    return tree


@st.composite
def contents(draw, content: bytes) -> bytes:
    """The bytes of a file with up to five changes: bits, cuts, insertions, repetitions, an end."""
    changed = bytearray(content)
    for _ in range(draw(st.integers(1, 5))):
        if not changed:
            break
        # More often near the beginning, where headers are.
        limit = draw(st.sampled_from([60, 300, len(changed)]))
        index = draw(st.integers(0, min(limit, len(changed)) - 1))
        change = draw(st.sampled_from(["flip", "cut", "fill", "snippet", "repeat", "end"]))
        if change == "flip":
            changed[index] ^= 1 << draw(st.integers(0, 7))
        elif change == "cut":
            del changed[index : index + draw(st.integers(1, 50))]
        elif change == "fill":
            changed[index:index] = draw(st.binary(min_size=1, max_size=20))
        elif change == "snippet":
            changed[index:index] = draw(st.sampled_from(SNIPPETS))
        elif change == "repeat":
            changed[index:index] = changed[index // 2 : index // 2 + 40]
        else:
            del changed[index:]
    return bytes(changed)
