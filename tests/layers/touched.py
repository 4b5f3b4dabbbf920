"""Run the tests nearest to what changed since the main branch, without those that are slow.

    python -m tests.layers.touched [pytest options]

Changed are files in commits since main, uncommitted ones and new ones.
"""

import ast
import functools
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

import pytest

from tests.modules import PACKAGES, ROOT, parse


def main(options: list[str]) -> int:
    """Run pytest on the files of `nearest_tests`, and return its exit status."""
    base = _git("merge-base", "HEAD", "main")
    changed = _git("diff", "--name-only", *base, "--", "*.py")
    new = _git("ls-files", "--others", "--exclude-standard", "--", "*.py")
    files = nearest_tests([*changed, *new])
    print(*files, sep="\n")
    if not files:
        return 0
    status = pytest.main(["-n", "0", "-q", "-m", "not slow", *options, *files])
    return 0 if status == pytest.ExitCode.NO_TESTS_COLLECTED else status


def nearest_tests(changed: Iterable[str]) -> list[str]:
    """Test files or folders nearest to changed Python files; paths are from the root.

    A test file is its own test. A module `jaxbeam/model/modes.py` has the files called
    `test_modes.py` in `tests/model`; without them those there that import it; without them the
    nearest folder of tests, or what imports its package. A helper of the tests has the test files
    that import it.
    """
    return sorted({file for path in changed for file in _tests_near(PurePosixPath(path))})


def _tests_near(path: PurePosixPath) -> list[str]:
    if path.parts[0] == "tests" and path.name.startswith("test_"):
        return [str(path)] if (ROOT / path).exists() else []
    module = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
    if path.parts[0] == "tests":
        return [file for file, names in _imports().items() if module in names]
    if path.parts[0] not in PACKAGES or module in ("jaxbeam", "jaxbeam.__main__"):
        return []
    # Tests of jaxbeam are not in a folder of that name; those of a package without a folder are
    # anywhere.
    folder = PurePosixPath("tests", *path.parent.parts[path.parts[0] == "jaxbeam" :])
    while not (ROOT / folder).exists():
        folder = folder.parent
    area = "/".join(folder.parts[:2])
    near = {file: names for file, names in _imports().items() if file.startswith(f"{area}/")}
    named = [file for file in near if file.endswith(f"/test_{module.rpartition('.')[2]}.py")]
    importing = [file for file, names in near.items() if module in names]
    inside = [file for file, names in near.items() if module.rpartition(".")[0] in names]
    return named or importing or (inside if area == "tests" else [str(folder)])


@functools.cache
def _imports() -> dict[str, set[str]]:
    """What each test file imports: names of modules, and of what is imported from them."""
    paths = sorted((ROOT / "tests").rglob("test_*.py"))
    return {path.relative_to(ROOT).as_posix(): _imported(path) for path in paths}


def _imported(path: Path) -> set[str]:
    names = set()
    for node in parse(path).body:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names} | {str(node.module)}
    return names


def _git(*words: str) -> list[str]:
    done = subprocess.run(["git", *words], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    return done.stdout.splitlines()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
