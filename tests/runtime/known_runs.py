"""Runs of the examples and the published rigs, as hashes of all their numbers.

`python -m tests.runtime.known_runs [NAME ...]` prints them as JSON; with JAX and without they are
the same to the last bit (`test_without_jax.py`, `.ci/without_jax`).
"""

import hashlib
import json
import sys
from importlib import resources
from pathlib import Path

import numpy as np

import jaxbeam as jb

ROOT = Path(__file__).parents[2]


def cases():
    """Paths of the cases by name."""
    found = {path.parent.name: path for path in ROOT.glob("examples/*/case.toml")}
    rigs = Path(str(resources.files("jaxbeam.case.library.rigs")))
    return dict(sorted((found | {path.stem: path for path in rigs.glob("*.toml")}).items()))


def fingerprint(path):
    """Hash of the numbers of a run: readings, commands, contact forces, envelope."""
    record = jb.simulate(jb.load_case(path))
    envelope = record.envelope("deflection")
    parts = (record.times, record.deflection, record.command, record.contact_force)
    numbers = [*parts, envelope.smallest, envelope.largest]
    return hashlib.sha256(b"".join(np.asarray(one, float).tobytes() for one in numbers)).hexdigest()


def main(names):
    """Hashes by name."""
    chosen = {name: path for name, path in cases().items() if not names or name in names}
    return {name: fingerprint(path) for name, path in chosen.items()}


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1:]), indent=1))
