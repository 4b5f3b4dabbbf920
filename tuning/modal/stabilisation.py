"""Stabilisation diagram: poles of models of rising order, and the modes among them.

A structure's poles return at every order that is high enough, those of noise do not. Poles of
successive orders are joined to a chain, one of each order at most, if they agree (Peeters and De
Roeck 1999 give the usual limits); the chains that are long enough and determined well enough are
the modes (in the manner of Reynders, Houbrechts and De Roeck 2012, and Neu et al. 2017, with the
uncertainties in place of their clusters of validation criteria).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from tuning.modal.result import MAX_DAMPING_RATIO, SAME_MAC, mac_matrix
from tuning.modal.subspace import Poles

MAX_FREQUENCY_CHANGE = 0.01  # relative, between neighbouring orders
MAX_DAMPING_CHANGE = 0.5  # relative to the larger damping ratio
DAMPING_FLOOR = 0.002  # damping ratio added to it
MAX_SKIPPED_ORDERS = 3  # orders in which a chain may lack a pole
MIN_CHAIN_FRACTION = 0.4  # of the orders from its first on
MIN_CHAIN_ORDERS = 6  # likewise


class Chain(NamedTuple):
    """Poles of one mode at successive orders: their indices, and that of the representative."""

    members: Int[np.ndarray, " member"]
    best: int


class Diagram(NamedTuple):
    """Stabilisation diagram: all poles, which of them are stable, and the chains of modes."""

    poles: Poles
    stable: Bool[np.ndarray, " pole"]
    chains: tuple[Chain, ...]
    orders: tuple[int, ...]


def possible(poles: Poles, band: tuple[float, float]) -> Bool[np.ndarray, " pole"]:
    """Mask of the poles that may be modes: damped, by less than 20 %, and in the band (Hz)."""
    damping, frequency = poles.damping_ratios, poles.frequencies
    return (
        (damping > 0)
        & (damping < MAX_DAMPING_RATIO)
        & (frequency >= band[0])
        & (frequency <= band[1])
    )


def stabilise(poles: Poles, band: tuple[float, float]) -> Diagram:
    """Chains of poles of successive orders; `poles` of all orders together."""
    orders = np.unique(poles.orders)
    keep = possible(poles, band)
    chains: list[list[int]] = []
    last: list[int] = []  # index of the order of the last member of each chain
    for step, order in enumerate(orders):
        index = np.flatnonzero(keep & (poles.orders == order))
        open_chains = [i for i, seen in enumerate(last) if step - seen <= MAX_SKIPPED_ORDERS]
        ends = np.array([chains[i][-1] for i in open_chains], int)
        for chain, pole in _pairs(poles, ends, index):
            chains[open_chains[chain]].append(int(index[pole]))
            last[open_chains[chain]] = step
        taken = {chain[-1] for chain in chains}
        for pole in index:
            if int(pole) not in taken:
                chains.append([int(pole)])
                last.append(step)
    found = []
    for chain in chains:
        members = np.array(chain)
        after = np.sum(orders >= poles.orders[members[0]])
        if members.size >= max(MIN_CHAIN_ORDERS, MIN_CHAIN_FRACTION * after):
            found.append(Chain(members, _representative(poles, members)))
    found.sort(key=lambda chain: poles.frequencies[chain.best])
    stable = np.zeros(poles.poles.size, bool)
    for chain in chains:
        if len(chain) >= 3:
            stable[chain] = True
    return Diagram(poles, stable, tuple(found), tuple(int(order) for order in orders))


def _pairs(poles: Poles, ends, index):
    """Pairs (chain, pole) that agree, the nearest first, each used once."""
    if not ends.size or not index.size:
        return []
    distance = _distances(poles, ends, index)
    pairs, used_ends, used = [], set(), set()
    for flat in np.argsort(distance, axis=None):
        chain, pole = divmod(int(flat), index.size)
        if not np.isfinite(distance[chain, pole]):
            break
        if chain not in used_ends and pole not in used:
            pairs.append((chain, pole))
            used_ends.add(chain)
            used.add(pole)
    return pairs


def _distances(poles: Poles, ends, index) -> Float[np.ndarray, "chain pole"]:
    """Relative distance of poles plus 1 - MAC; infinite for pairs that disagree."""
    frequency, damping = poles.frequencies, poles.damping_ratios
    shift = np.abs(frequency[ends][:, None] / frequency[index] - 1)
    change = np.abs(damping[ends][:, None] - damping[index])
    larger = np.maximum(damping[ends][:, None], damping[index]) + DAMPING_FLOOR
    mac = mac_matrix(poles.shapes[ends], poles.shapes[index])
    relative = np.abs(poles.poles[ends][:, None] - poles.poles[index]) / np.abs(poles.poles[index])
    agree = (
        (shift < MAX_FREQUENCY_CHANGE) & (change < MAX_DAMPING_CHANGE * larger) & (mac > SAME_MAC)
    )
    return np.where(agree, relative + 1 - mac, np.inf)


def _representative(poles: Poles, members) -> int:
    """The member nearest to the median pole of the chain."""
    values = poles.poles[members]
    centre = np.median(values.real) + 1j * np.median(values.imag)
    return int(members[np.argmin(np.abs(values - centre))])
