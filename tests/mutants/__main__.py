"""Change the code at random places, and see whether the tests that should notice do.

    python -m tests.mutants --seed 1 --count 40 [--only model] [--seconds 3600]

needs the group `mutants` (cosmic-ray). Mutants are drawn with the seed from the files of
`targets.toml`, in a copy of the repository; each is told to its own tests: the quick ones of a
file, those named one by one, and where no quick one notices the slow ones, those of the nightly
run too. A test that fails without the change, too, is an error.
Mutants in `left.toml` may survive, with the reason given there; the exit status is 1 if more than
LARGEST_SHARE of the others do.
"""

import argparse
import fnmatch
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import NamedTuple

FOLDER, ROOT = Path(__file__).parent, Path(__file__).parents[2]
LARGEST_SHARE = 0.1  # of mutants that may survive
COPIED = (
    *("jaxbeam", "tuning", "experiments", "tests", "examples", "docs"),
    *("pyproject.toml", "hatch_build.py"),
)
# Operators that change numbers or branches; others change what is no code of the library's own.
ARITHMETIC = ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "Mul_Add", "Pow_Mul")
COMPARISONS = ("Lt_LtE", "LtE_Lt", "Gt_GtE", "GtE_Gt", "Lt_GtE", "Gt_LtE", "Eq_NotEq")
OPERATORS = (
    *(f"core/ReplaceBinaryOperator_{name}" for name in ARITHMETIC),
    *(f"core/ReplaceComparisonOperator_{name}" for name in COMPARISONS),
    "core/ReplaceUnaryOperator_Delete_USub",
    "core/ReplaceUnaryOperator_Delete_Not",
    "core/ReplaceAndWithOr",
    "core/ReplaceOrWithAnd",
    "core/ReplaceTrueWithFalse",
    "core/ReplaceFalseWithTrue",
    "core/NumberReplacer",
)


class Mutant(NamedTuple):
    """A change of a file: its line before and after, and the code of the whole file after it."""

    file: str
    before: str
    after: str
    code: str


def patterns() -> tuple[list[str], dict[str, list[str]]]:
    """Patterns of the files whose numbers no mutant changes, and those of others with their tests.

    The first that fits a file counts, of the former first.
    """
    read = tomllib.loads((FOLDER / "targets.toml").read_text())
    return read["no_numbers"], read["targets"]


def first_fit(name: str) -> str | None:
    """The pattern that counts for a file, or None."""
    no_numbers, tests = patterns()
    return next((p for p in (*no_numbers, *tests) if fnmatch.fnmatch(name, p)), None)


def targets() -> dict[str, list[str]]:
    """Tests of each file of the library that has some, by its path."""
    tests, found = patterns()[1], {}
    for path in sorted((ROOT / "jaxbeam").rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        pattern = first_fit(name)
        if pattern in tests:
            found[name] = tests[pattern]
    return found


def left_ones() -> list[dict[str, str]]:
    """Mutants that may survive. Raises ValueError for one whose line is no longer there."""
    entries = tomllib.loads((FOLDER / "left.toml").read_text()).get("mutants", [])
    for entry in entries:
        lines = (ROOT / entry["file"]).read_text().splitlines()
        if not entry["why"] or entry["before"] not in (line.strip() for line in lines):
            raise ValueError(f"left.toml: {entry['file']} has no line {entry['before']!r}")
    return entries


def drawn_mutant(name: str, draw: random.Random) -> Mutant | None:
    """One of all mutants of a file, each with the same chance; None if there is none."""
    from cosmic_ray.ast import ast_nodes, get_ast  # pyright: ignore[reportMissingImports]
    from cosmic_ray.mutating import mutate_code  # pyright: ignore[reportMissingImports]
    from cosmic_ray.plugins import get_operator  # pyright: ignore[reportMissingImports]

    code = (ROOT / name).read_text()
    nodes, changes = list(ast_nodes(get_ast(code))), []
    for operator in (get_operator(each)() for each in OPERATORS):
        count = sum(len(list(operator.mutation_positions(node))) for node in nodes)
        changes += [(operator, occurrence) for occurrence in range(count)]
    for operator, occurrence in draw.sample(changes, len(changes)):
        changed = mutate_code(code, operator, occurrence)
        lines = zip(code.splitlines(), changed.splitlines(), strict=True)
        pair = next(((a.strip(), b.strip()) for a, b in lines if a != b), None)
        if pair is not None and _changes_numbers(*pair):
            return Mutant(name, *pair, changed)
    return None


def _changes_numbers(line: str, after: str) -> bool:
    """Whether a changed line may change results: no import, declaration, message or signature.

    Nor a check of equal lengths that is left out.
    """
    if line.replace("strict=True", "strict=False") == after:
        return False
    no_code = "import ", "from ", "def ", "class ", "@", 'f"', '"', "raise ", "#"
    return not line.startswith(no_code) and " Float[" not in line and "warn" not in line


class Copy:
    """Copy of the repository in which files may be changed."""

    def __init__(self, folder: str):
        self.folder = Path(folder)
        for name in COPIED:
            source, place = ROOT / name, self.folder / name
            if source.is_dir():
                shutil.copytree(source, place, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source, place)

    def failure(self, tests: list[str], limit: float) -> str | None:
        """First of some tests that fails or outlasts a limit (s), or the file; None if all pass."""
        whole = [test for test in tests if "::" not in test]
        single = [test for test in tests if "::" in test]
        runs = [single] if single else []
        if whole:
            runs = [[*whole, "-m", "not slow"], *runs, [*whole, "-m", "slow", "--nightly"]]
        return next((found for run in runs if (found := self._failure(run, limit))), None)

    def _failure(self, arguments: list[str], limit: float) -> str | None:
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider"]
        # What does not change is compiled once for all mutants.
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(self.folder / "compiled")}
        try:
            done = subprocess.run(
                [*command, *arguments],
                cwd=self.folder,
                env=environment,
                timeout=limit,
                capture_output=True,
                text=True,
            )
        except subprocess.TimeoutExpired:
            return arguments[0]
        failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
        passed = done.returncode in (0, 5)  # 5: none is slow
        return None if passed else failed[1] if failed else arguments[0]


def main() -> int:
    """Run the mutants that the command line asks for; the exit status."""
    parser = argparse.ArgumentParser(description="Changes of the code that tests should notice.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=40, help="mutants")
    parser.add_argument("--only", default="", help="part of the paths of the files")
    parser.add_argument("--limit", type=float, default=1800.0, help="s, for tests of one mutant")
    parser.add_argument("--seconds", type=float, default=3600.0, help="after which none begins")
    options = parser.parse_args()
    left = {(each["file"], each["before"], each["after"]) for each in left_ones()}
    tests = {name: own for name, own in targets().items() if options.only in name}
    drawn = random.Random(options.seed).choices(
        list(tests), [(ROOT / name).stat().st_size for name in tests], k=options.count
    )
    end, tried, survived = time.monotonic() + options.seconds, 0, []
    tested: set[tuple[str, ...]] = set()
    healthy: set[str] = set()
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(folder)
        for i, name in enumerate(drawn):
            if time.monotonic() > end:
                break
            mutant = drawn_mutant(name, random.Random(f"{options.seed} {i}"))
            if mutant is None or mutant[:3] in tested:
                continue
            tested.add(mutant[:3])
            place = copy.folder / name
            place.write_text(mutant.code)
            killer = copy.failure(tests[name], options.limit)
            place.write_text((ROOT / name).read_text())
            if killer and killer not in healthy and copy.failure([killer], options.limit):
                print(f"error: without a change {killer} fails", flush=True)
                return 2
            allowed = mutant[:3] in left
            tried += not allowed
            if killer is None and not allowed:
                survived.append(mutant)
            if killer:
                healthy.add(killer)
            word = f"killed by {killer}" if killer else "survives"
            print(f"{name}: {mutant.before}  ->  {mutant.after}\n    {word}", flush=True)
    share = len(survived) / max(tried, 1)
    print(f"{len(survived)} of {tried} mutants survive ({share:.0%}); seed {options.seed}")
    return int(share > LARGEST_SHARE)


if __name__ == "__main__":
    sys.exit(main())
