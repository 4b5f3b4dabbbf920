"""The validation page: what jaxbeam was held against, and the errors found, computed anew.

    python -m experiments.validation.page

writes VALIDATION.md; it needs the repository with its tests, whose independent sources it uses.
"""

import platform
import sys
import time
import warnings
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from jaxbeam.simulation.simulate import ContactLossWarning

if TYPE_CHECKING:
    from experiments.validation.checks import Check

PAGE_FILE = Path(__file__).parents[2] / "VALIDATION.md"
PAGE_HEAD = """# Validation

Each row holds jaxbeam against something that shares no code with it: closed forms, finite elements,
scipy, another solver. The errors are relative, and were computed when this page was written, by

    .venv/bin/uv run python -m experiments.validation.page

which fails if one is above what is allowed. Nothing here is typed in. The sources are in
`tests/oracles`; the tests compare many more cases with them.
"""


def run_checks() -> list[tuple[str, list["Check"]]]:
    """All checks, by what they are about.

    Raises RuntimeError where the repository's tests cannot be found.
    """
    try:
        from experiments.validation.checks import CHECKS
    except ModuleNotFoundError as error:
        raise RuntimeError(
            f"the independent sources are in the repository, not in the package ({error});"
            " run it from the root of a clone"
        ) from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)  # of no concern to an equation
        found = []
        for group in CHECKS:
            start = time.perf_counter()
            found.append((str(group.__doc__).rstrip("."), list(group())))
            print(f"{group.__name__}: {time.perf_counter() - start:.0f} s", flush=True)
        return found


def validation_page(groups: Sequence[tuple[str, Sequence["Check"]]]) -> str:
    """The page: a table for each group of checks."""
    checks = [check for _, group in groups for check in group]
    passed = sum(check.passed for check in checks)
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("jaxbeam", "jax", "scipy"))
    parts = [
        PAGE_HEAD,
        f"**{passed} of {len(checks)} checks are within what is allowed**"
        f" ({versions}, Python {platform.python_version()}).",
    ]
    for title, group in groups:
        rows = ["| what | held against | error | allowed | |", "| --- | --- | ---: | ---: | --- |"]
        rows += [
            f"| {c.quantity} | {c.reference} | {c.error:.1e} | {c.tolerance:.0e} |"
            f" {'within' if c.passed else '**above**'} |"
            for c in group
        ]
        parts += [f"\n## {title}\n", "\n".join(rows)]
    return "\n".join(parts) + "\n"


def main() -> int:
    """Write the page; return 1 if a check failed."""
    start = time.perf_counter()
    groups = run_checks()
    PAGE_FILE.write_text(validation_page(groups), encoding="utf-8")
    failed = [check for _, group in groups for check in group if not check.passed]
    for check in failed:
        print(f"{check.quantity}: error {check.error:.1e}, allowed {check.tolerance:.0e}")
    print(f"written: {PAGE_FILE.name}, in {time.perf_counter() - start:.0f} s")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
