"""The source files of the packages, for the tests that read code."""

import ast
from pathlib import Path

ROOT = Path(__file__).parent.parent
DATA = ROOT / "tests" / "data"
PACKAGES = ("jaxbeam", "tuning", "experiments")


def module_files() -> dict[str, Path]:
    """Every module by dotted name; a package itself is called `package.__init__`."""
    paths = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in paths}


def parse(path: Path) -> ast.Module:
    """The syntax tree of a source file."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))
