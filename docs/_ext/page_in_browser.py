"""The page without a server, in the folder `app` of the site: its files, and the library as a zip.

`jaxbeam/cli/page/static/worker.js` loads Python as WebAssembly and the library into it.
"""

import shutil
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
STATIC = ROOT / "jaxbeam" / "cli" / "page" / "static"
ENDINGS = {".py", ".pyi", ".toml", ".csv", ".json"}
MARK = '<meta name="jaxbeam-worker" content="static/worker.js">'


def write_page(folder: Path) -> None:
    """Write the page and the archive of the library to a folder."""
    shutil.copytree(STATIC, folder / "static", dirs_exist_ok=True)
    text = (STATIC / "index.html").read_text(encoding="utf-8")
    folder.joinpath("index.html").write_text(text.replace("<title>", f"{MARK}\n<title>"), "utf-8")
    with zipfile.ZipFile(folder / "jaxbeam.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted((ROOT / "jaxbeam").rglob("*")):
            if path.suffix in ENDINGS:
                archive.write(path, path.relative_to(ROOT))


def _finished(app, error):
    if error is None and app.builder.name == "html":
        write_page(Path(app.outdir) / "app")


def setup(app):
    """Connect to the end of the build."""
    app.connect("build-finished", _finished)
    return {"parallel_read_safe": True}
