"""Formulas of EN 1991-2, section 6.4 and annex C; numbers and sources in `en1991_2.toml`."""

import functools
import tomllib
from importlib import resources
from typing import Any, NamedTuple

from jaxtyping import Float

from jaxbeam.runtime.arrays import Array, xp


@functools.cache
def code_numbers() -> dict[str, Any]:
    """Numbers of the code by subject, with clause and source (see `en1991_2.toml`)."""
    text = (resources.files(__package__) / "en1991_2.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


class FrequencyLimits(NamedTuple):
    """Limits (Hz) of the first natural frequency n0, figure 6.10."""

    lower: Float[Array, "..."]
    upper: Float[Array, "..."]


def frequency_limits(length) -> FrequencyLimits:
    """Limits of n0 for a span or determinant length (m), up to 100 m: figure 6.10.

    n0 <= 94.76 L^-0.748; n0 >= 80 / L up to 20 m, 23.58 L^-0.592 beyond.
    """
    numbers = code_numbers()["frequency_limits"]
    (upper, upper_power), (lower, lower_power) = numbers["upper"], numbers["lower"]
    length = xp.asarray(length, float)
    short = length <= numbers["short_span"]
    return FrequencyLimits(
        xp.where(short, numbers["short_lower"] / length, lower * length**lower_power),
        upper * length**upper_power,
    )


def running_factor(speed, length, frequency) -> Float[Array, "..."]:
    """Dynamic increment phi' of a train on perfect track, annex C.

    phi' = K / (1 - K + K^4) with K = v / (2 L n0) up to 0.76, then 1.325; v in m/s, the determinant
    length L in m, n0 in Hz.
    """
    numbers = code_numbers()["annex_c"]
    K = xp.asarray(speed, float) / (2 * length * frequency)
    within = xp.minimum(K, numbers["largest_ratio"])
    beyond = numbers["largest_ratio"] < K
    return xp.where(beyond, numbers["limit"], within / (1 - within + within**4))


def irregularity_factor(speed, length, frequency) -> Float[Array, "..."]:
    """Dynamic increment phi'' from irregularities of the track, annex C; not below zero.

    phi'' = alpha / 100 (56 exp(-(L/10)^2) + 50 (n0 L / 80 - 1) exp(-(L/20)^2)), alpha = v / 22 up
    to 1; units as in `running_factor`.
    """
    numbers = code_numbers()["annex_c"]
    alpha = xp.minimum(xp.asarray(speed, float) / numbers["reference_speed"], 1.0)
    (short, long), (first, second) = numbers["lengths"], numbers["factors"]
    length = xp.asarray(length, float)
    relative = length * frequency / numbers["frequency_length"] - 1
    percent = first * xp.exp(-((length / short) ** 2))
    percent = percent + second * relative * xp.exp(-((length / long) ** 2))
    return xp.maximum(alpha / 100 * percent, 0.0)


def track_factor(speed, length, frequency, track: str) -> Float[Array, "..."]:
    """Factor of calculated dynamic effects for the state of the track: 1 + phi'' or 1 + phi''/2.

    The whole phi'' for a "standard" track, half of it for one carefully "maintained"; units as in
    `running_factor`.
    """
    part = code_numbers()["dynamic_factors"][track]["track_irregularity"]
    return 1 + part * irregularity_factor(speed, length, frequency)


def static_dynamic_factor(length, track: str) -> Float[Array, "..."]:
    """Dynamic factor Phi_2 (carefully "maintained" track) or Phi_3 ("standard") of LM71, 6.4.5.2.

    The determinant length is in m.
    """
    numbers = code_numbers()["dynamic_factors"][track]
    factor = numbers["a"] / (xp.sqrt(xp.asarray(length, float)) - 0.2) + numbers["b"]
    return xp.clip(factor, *numbers["limits"])
