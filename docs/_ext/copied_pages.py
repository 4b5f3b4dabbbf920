"""Pages that live elsewhere: the notebooks, which the site shows as tutorials."""

import os
import shutil
from pathlib import Path

ROOT = Path(__file__).parents[2]


def _copy(app):
    """Copy the notebooks into the source folder; those of the tests if they have run."""
    notebooks = Path(os.environ.get("JAXBEAM_NOTEBOOKS", ROOT / "notebooks"))
    target = Path(app.srcdir) / "tutorials" / "notebooks"
    target.mkdir(parents=True, exist_ok=True)
    for old in target.glob("*.ipynb"):
        if not (notebooks / old.name).exists():
            old.unlink()
    for path in sorted(notebooks.glob("*.ipynb")):
        copy = target / path.name
        if not copy.exists() or copy.read_bytes() != path.read_bytes():
            shutil.copyfile(path, copy)


def setup(app):
    """Connect to the start of the build."""
    app.connect("builder-inited", _copy)
    return {"parallel_read_safe": True}
