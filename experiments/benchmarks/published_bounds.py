"""Bounds of the published loads of `jaxbeam.benchmark`, and scores of its baselines, as stored.

    python -m experiments.benchmarks.published_bounds [PROBLEM ...]

Writes jaxbeam/benchmark/bounds.json and baselines.json. A published version is not computed again:
this is for a next one, or to see that nothing has changed (git diff).
"""

import json
import warnings
from pathlib import Path

import jaxbeam as jb
from experiments.benchmarks.common import parser
from jaxbeam.benchmark import problem as problems, scoring as scores

FOLDER = Path(problems.__file__).parent
DIGITS = 12


def write_bounds() -> None:
    """Compute and write the bounds and scores of the problems named, or of all."""
    options = parser(__doc__)
    options.add_argument("names", nargs="*", metavar="PROBLEM", help=", ".join(problems.names()))
    names = options.parse_args().names or problems.names()
    warnings.simplefilter("ignore")
    for name in names:
        problem = problems.load(name)
        loads = {
            "training": list(problem.training),
            "test": [problem.test_load(seed) for seed in problems.TEST_SEEDS],
        }
        _write(
            "bounds",
            name,
            {
                kind: [_row(scores.compute_attainable(problem, one)) for one in rows]
                for kind, rows in loads.items()
            },
        )
        scores.clear()
        own = jb.benchmark.score(problem)
        _write("baselines", name, {"shares": _plain(own.shares), "peaks": _plain(own.peaks)})
        print(f"{name}: {own.mean:.1%}, worst {own.worst:.1%}", flush=True)


def _row(found: scores.Attainable) -> list:
    load, uncontrolled, bound, places, weights = found
    plain = _plain(load), _plain(uncontrolled), _plain(bound), places.tolist(), _plain(weights)
    return list(plain)


def _plain(value):
    """Numbers with so many digits that a difference is one of the numbers."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list):
        return [_plain(one) for one in value]
    return float(f"{value:.{DIGITS}g}")


def _write(file: str, name: str, content: dict) -> None:
    path = FOLDER / f"{file}.json"
    stored = json.loads(path.read_text("utf-8")) if path.is_file() else {}
    stored[name] = content
    ordered = {one: stored[one] for one in problems.names() if one in stored}
    lines = [f"{json.dumps(one)}: {json.dumps(ordered[one])}" for one in ordered]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    write_bounds()
