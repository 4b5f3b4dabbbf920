"""Line loads of codes, by name."""

import functools
import tomllib
from importlib import resources
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class CodeLineLoad(NamedTuple):
    """Parts of a line load: N/m, lengths (m, 0 for a part without an end), gaps (m) before them.

    Axles are at offsets (m) behind the end of the first part, with forces in N.
    """

    force_per_length: Float[np.ndarray, " part"]
    lengths: Float[np.ndarray, " part"]
    gaps: Float[np.ndarray, " part"]
    axle_offsets: Float[np.ndarray, " axle"]
    axle_forces: Float[np.ndarray, " axle"]
    source: str


@functools.cache
def line_loads() -> dict[str, CodeLineLoad]:
    """All line loads of the library by name."""
    text = (resources.files(__package__) / "line_loads.toml").read_text(encoding="utf-8")
    content = tomllib.loads(text)
    names = ("force_per_length", "lengths", "gaps", "axle_offsets", "axle_forces")
    return {
        table["name"]: CodeLineLoad(
            source=content["source"],
            **{name: np.array(table.get(name, []), float) for name in names},
        )
        for table in content["loads"]
    }
