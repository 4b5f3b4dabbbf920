"""Write the validation page, VALIDATION.md; fail if an error exceeds its tolerance.

    python -m experiments.validation

It needs a clone of the repository, whose tests have the independent references.
"""

import sys
import time
import warnings

from experiments.validation import checks
from experiments.validation.checks import PAGE_FILE, Check, validation_page
from jaxbeam.simulation.simulate import ContactLossWarning

# They yield the checks of a group, whose title is their docstring.
GROUPS = (
    checks.frequencies,
    checks.statics,
    checks.crossings,
    checks.energy,
    checks.gradients,
    checks.loops,
    checks.bounds,
)


def run_checks() -> list[tuple[str, list[Check]]]:
    """Titles and checks of all groups; prints the wall time of each group."""
    results = []
    with warnings.catch_warnings():
        # Moving masses that would lift off solve the same equations.
        warnings.simplefilter("ignore", ContactLossWarning)
        for group in GROUPS:
            start = time.perf_counter()
            results.append((str(group.__doc__).rstrip("."), list(group())))
            print(f"{group.__name__}: {time.perf_counter() - start:.0f} s", flush=True)
    return results


def main() -> int:
    """Write the page; return 1 if an error exceeds its tolerance, else 0."""
    start = time.perf_counter()
    groups = run_checks()
    PAGE_FILE.write_text(validation_page(groups), encoding="utf-8")
    failed = [check for _, group in groups for check in group if not check.passed]
    for check in failed:
        print(f"{check.quantity}: error {check.error:.1e}, tolerance {check.tolerance:.0e}")
    print(f"written: {PAGE_FILE.name}, in {time.perf_counter() - start:.0f} s")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
