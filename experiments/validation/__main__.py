"""Write the validation page, VALIDATION.md; fail if an error exceeds its tolerance.

    python -m experiments.validation

It needs a clone of the repository, whose tests have the independent references.
"""

import sys
import time

from experiments.validation.page import PAGE_FILE, run_checks, validation_page


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
