"""Pages that live elsewhere: the notebooks, which the site shows as tutorials.

Where the address of the repository is known, as in the workflow that publishes the site, each of
them begins with a link that opens it in Binder, which installs jaxbeam by `.binder/`.
"""

import json
import os
import shutil
from pathlib import Path
from urllib.parse import quote

ROOT = Path(__file__).parents[2]
BINDER = "https://mybinder.org/v2/gh/{repository}/HEAD?labpath={path}"


def with_link(notebook: str, name: str, repository: str) -> str:
    """A notebook (JSON) with a link to Binder below its title.

    `repository` is "owner/name" on GitHub.
    """
    cells = json.loads(notebook)
    address = BINDER.format(repository=repository, path=quote(f"notebooks/{name}", safe=""))
    cell = {
        "cell_type": "markdown",
        "id": "binder",
        "metadata": {},
        "source": [f"[Open this notebook in Binder]({address}): it can be changed and run there."],
    }
    cells["cells"].insert(1, cell)
    return json.dumps(cells, indent=1)


def _copy(app):
    """Copy the notebooks into the source folder; those of the tests if they have run."""
    notebooks = Path(os.environ.get("JAXBEAM_NOTEBOOKS", ROOT / "notebooks"))
    repository = os.environ.get("GITHUB_REPOSITORY")
    target = Path(app.srcdir) / "tutorials" / "notebooks"
    target.mkdir(parents=True, exist_ok=True)
    for old in target.glob("*.ipynb"):
        if not (notebooks / old.name).exists():
            old.unlink()
    for path in sorted(notebooks.glob("*.ipynb")):
        copy = target / path.name
        if repository:
            text = path.read_text(encoding="utf-8")
            copy.write_text(with_link(text, path.name, repository), encoding="utf-8")
        elif not copy.exists() or copy.read_bytes() != path.read_bytes():
            shutil.copyfile(path, copy)


def setup(app):
    """Connect to the start of the build."""
    app.connect("builder-inited", _copy)
    return {"parallel_read_safe": True}
