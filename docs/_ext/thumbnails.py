"""Directive `thumbnails PAGE`: small pictures of all sections of a page that have one, with links.

They are made when the site is built, of the first picture of each section, and lie in `_thumbnails`
beside the pages.
"""

import html
import os
from pathlib import Path

from docutils import nodes
from PIL import Image
from sphinx.util.docutils import SphinxDirective

SIZE = 320, 240  # pixels; twice as many as are shown, for dense screens
FOLDER = "_thumbnails"


class Wanted(nodes.General, nodes.Element):
    """The place of the thumbnails of a page, until all pages have been read."""


class Thumbnails(SphinxDirective):
    """Thumbnails of a page."""

    required_arguments = 1

    def run(self):
        """The place; filled in when the page is written."""
        self.env.note_reread()
        return [Wanted(page=self.arguments[0])]


def thumbnail(path: Path) -> Image.Image:
    """A picture, or the middle frame of a film, in SIZE on white: its top if it is higher."""
    with Image.open(path) as opened:
        frames = getattr(opened, "n_frames", 1)
        if frames > 1:
            opened.seek(frames // 2)
        picture = opened.convert("RGBA")
    width, height = SIZE
    small = picture.resize((width, round(picture.height * width / picture.width)), Image.LANCZOS)
    small = small.crop((0, 0, width, min(height, small.height)))
    result = Image.new("RGBA", SIZE, "white")
    result.alpha_composite(small, (0, (height - small.height) // 2))
    return result.convert("RGB")


def pictures(doctree: nodes.document) -> list[tuple[str, str, str]]:
    """Anchor, title and address of the first picture of each section of a page that has one."""
    found = []
    for section in doctree.findall(nodes.section):
        image = next(iter(section.findall(nodes.image)), None)
        if image is not None and isinstance(section.parent, nodes.section):
            title = section.next_node(nodes.title)
            found.append((section["ids"][0], title.astext(), image["uri"]))
    return found


def _fill(app, doctree, docname):
    """Write the thumbnails, and put them in their place."""
    for place in list(doctree.findall(Wanted)):
        if app.builder.format != "html":
            place.parent.remove(place)
            continue
        page = place["page"]
        folder = Path(app.outdir) / FOLDER
        folder.mkdir(exist_ok=True)
        base = app.builder.get_relative_uri(docname, page)
        up = os.path.relpath(folder, Path(app.outdir) / Path(docname).parent)
        cells = []
        for anchor, title, uri in pictures(app.env.get_doctree(page)):
            thumbnail(Path(app.srcdir) / uri).save(folder / f"{anchor}.webp", quality=80)
            words = html.escape(title.partition(". ")[2] or title)
            cells.append(
                f'<a href="{base}#{anchor}"><img src="{up}/{anchor}.webp" alt="" loading="lazy"'
                f' width="{SIZE[0]}" height="{SIZE[1]}"><span>{words}</span></a>'
            )
        text = f'<div class="thumbnails">{"".join(cells)}</div>'
        place.replace_self(nodes.raw("", text, format="html"))


def setup(app):
    """Register the directive."""
    app.add_node(Wanted)
    app.add_directive("thumbnails", Thumbnails)
    app.connect("doctree-resolved", _fill)
    return {"parallel_read_safe": True, "parallel_write_safe": False}
