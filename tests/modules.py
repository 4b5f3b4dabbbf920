"""Source files of the packages, for tests of the code itself."""

import ast
from pathlib import Path

ROOT = Path(__file__).parent.parent
DATA = ROOT / "tests" / "data"
PACKAGES = ("jaxbeam", "tuning", "experiments")


def module_files() -> dict[str, Path]:
    """Paths of all modules by dotted name; that of a package ends in `.__init__`."""
    paths = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in paths}


def parse(path: Path) -> ast.Module:
    """The syntax tree of a source file."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))
