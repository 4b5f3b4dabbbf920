"""Channels of one run with clocks of their own: joined over the time that they have in common."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Names, in small letters, of numbers stored with the channels that define their times.
RATES = ("sample_rate", "sampling_rate", "samplerate", "fs", "rate")  # Hz
STEPS = ("dt", "time_step", "wf_increment")  # s
STARTS = ("start_time", "t0", "wf_start_offset")  # s
CUT = 0.05  # of the time in common: more that is cut off is said, also of slow channels
SAME = 0.01  # of a step: largest difference of equal start times, rounded to microseconds


class Clock(NamedTuple):
    """Time of the first sample and step of a channel, in s."""

    start: float
    step: float


def join_channels(
    source: str,
    channels: Mapping[str, np.ndarray],
    clocks: Mapping[str, Clock],
) -> tuple[Float[np.ndarray, " time"], dict[str, np.ndarray], list[str]]:
    """Common times (s) of the channels of one run, their values at these, and notes.

    Times are those of the channel with the shortest step, over the time that all have in common,
    from the start of the earliest. Others are interpolated (cubic spline) unless their samples are
    at these times.

    Raises ValueError for steps that are not positive, and channels without a time in common.
    """
    for name, clock in clocks.items():
        if not (0 < clock.step < np.inf and np.isfinite(clock.start)):
            raise ValueError(f"{source}: the sampling step of {name} is {clock.step:g} s")
    earliest = min(clock.start for clock in clocks.values())
    clocks = {name: Clock(one.start - earliest, one.step) for name, one in clocks.items()}
    ends = {n: one.start + one.step * (len(channels[n]) - 1) for n, one in clocks.items()}
    lead = min(clocks, key=lambda name: (clocks[name].step, clocks[name].start))
    step, slack = clocks[lead].step, SAME * clocks[lead].step
    longest = max(one.step for one in clocks.values())
    first = max(one.start for one in clocks.values())
    last = min(ends.values())
    spans = ", ".join(f"{n} {one.start:g} to {ends[n]:g} s" for n, one in clocks.items())
    low = int(np.ceil((first - clocks[lead].start) / step - SAME))
    high = int(np.floor((last - clocks[lead].start) / step + SAME))
    if high - low < 1:
        raise ValueError(
            f"{source}: its channels have no time in common: {spans}; save them to separate files"
        )
    times = clocks[lead].start + step * np.arange(low, high + 1)
    joined, interpolated = {}, []
    for name, (start, own) in clocks.items():
        values = channels[name]
        shift = (times[0] - start) / step
        if abs(own - step) * times.size < slack and abs(shift - round(shift)) < SAME:
            joined[name] = values[round(shift) : round(shift) + times.size]
            continue
        from scipy.interpolate import CubicSpline

        at = start + own * np.arange(len(values))
        joined[name] = CubicSpline(at, values, axis=0)(np.clip(times, at[0], at[-1]))
        interpolated.append(f"{name} ({1 / own:.6g} Hz, {start:g} s)")
    said = []
    if first > slack or max(ends.values()) - last > min(longest - slack, CUT * last):
        said.append(
            f"its channels have different times ({_shortened(spans)}): aligned by them, and read"
            f" from {times[0]:g} to {times[-1]:g} s, which they have in common"
        )
    if interpolated:
        said.append(
            f"interpolated to {1 / step:.6g} Hz, from rates and starts of their own:"
            f" {_shortened(', '.join(interpolated))}"
        )
    return times, joined, said


def _shortened(text: str) -> str:
    return text if len(text) <= 300 else f"{text[:300]} ..."


def clocks_of(
    names: Sequence[str], starts: Mapping[str, float], steps: Mapping[str, float]
) -> dict[str, Clock]:
    """Clocks of channels; a channel without a step has the step of the first that has one."""
    step = next(iter(steps.values()))
    return {name: Clock(starts.get(name, 0.0), steps.get(name, step)) for name in names}


def clocks_by_numbers(
    source: str, numbers: Mapping[str, Mapping[str, float]], names: Sequence[str]
) -> dict[str, Clock] | None:
    """Clocks of channels by numbers stored with them, as `fs`; None without a rate.

    Raises ValueError for a rate that is not positive, and for a rate and a step that contradict
    each other.
    """
    starts, steps = {}, {}
    for name in names:
        own = numbers[name]
        rates = [own[one] for one in RATES if one in own]
        given = [own[one] for one in STEPS if one in own]
        if any(not 0 < one < np.inf for one in (*rates, *given)):
            raise ValueError(f"{source}: the sampling rate or step of {name} is not positive")
        found = [1 / rate for rate in rates] + given
        if found and max(found) > (1 + 1e-3) * min(found):
            raise ValueError(
                f"{source}: the sampling rates and steps of {name} contradict each other"
            )
        if found:
            steps[name] = found[0]
        starts[name] = next((own[one] for one in STARTS if one in own), 0.0)
    return clocks_of(names, starts, steps) if steps else None
