"""Addresses with `*` for all parts of a list, `loads.*.speed`, written out for each of them."""

from collections.abc import Iterable, Mapping

ALL = "*"


def each_address(address: str, counts: Mapping[str, int]) -> list[str]:
    """Addresses for which one stands: itself, or with `*` that of each part of the list.

    `counts` has the number of parts at the keys of a case that hold lists.

    Raises ValueError if `*` stands elsewhere than for the parts of such a list, or for none.
    """
    key, *rest = address.split(".")
    if ALL not in address:
        return [address]
    if len(rest) < 2 or rest[0] != ALL or ALL in "".join(rest[1:]) or key not in counts:
        lists = ", ".join(f"{name}.*" for name in counts)
        raise ValueError(
            f"{address}: * stands for all parts of a list and is followed by a name, as in"
            f" loads.*.speed; lists are {lists}"
        )
    if not counts[key]:
        raise ValueError(f"{address} stands for no number: the case has no {key}")
    return [".".join([key, str(i), *rest[1:]]) for i in range(counts[key])]


def overlap(addresses: Iterable[str], counts: Mapping[str, int]) -> str | None:
    """The first address for which two of some addresses stand, or None."""
    seen = set()
    for address in addresses:
        for one in each_address(address, counts):
            if one in seen:
                return one
            seen.add(one)
    return None
