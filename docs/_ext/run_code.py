"""Directive `run`: code that a page shows and the build runs, with what it prints and draws.

All blocks of a page share their names and a folder of their own. An exception is an error of the
build, so that no page shows code that does not run or output that the code does not print.

- `run`: Python; the value of a last expression is printed, figures are shown.
- `run-command`: lines of a shell that begin with `jaxbeam`.
- `write NAME`: a file, written into the folder of the page and shown.
- `show NAME`: a picture that code or commands wrote into the folder.
"""

import ast
import contextlib
import io
import os
import shlex
import shutil
import sys
import tempfile
import warnings
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.util.docutils import SphinxDirective

MAX_LINES = 60


class Page:
    """Names, folder and pictures of one page."""

    def __init__(self):
        self.names = {"__name__": "__main__"}
        self.folder = Path(tempfile.mkdtemp(prefix="jaxbeam-docs-"))
        self.pictures = 0


@contextlib.contextmanager
def _inside(page: Page):
    """In the folder of a page, with standard output and error in the stream that it yields."""
    before, stream = Path.cwd(), io.StringIO()
    os.chdir(page.folder)
    try:
        with contextlib.redirect_stdout(stream), contextlib.redirect_stderr(stream):
            yield stream
    finally:
        os.chdir(before)


class RunBase(SphinxDirective):
    """What the directives have in common."""

    has_content = True
    option_spec = {
        "hide-code": directives.flag,
        "hide-output": directives.flag,
        "fails": directives.flag,
        "wrap": directives.flag,
        "alt": directives.unchanged,
        "width": directives.unchanged,
    }

    @property
    def page(self) -> Page:
        """The page that is read."""
        pages = self.env.temp_data.setdefault("run_pages", {})
        if self.env.docname not in pages:
            pages[self.env.docname] = Page()
        return pages[self.env.docname]

    def code(self, text: str, language: str, caption: str = "") -> list[nodes.Node]:
        """A block of code."""
        block = nodes.literal_block(text, text, language=language)
        if not caption:
            return [block]
        container = nodes.container("", literal_block=True, classes=["literal-block-wrapper"])
        container += nodes.caption("", "", nodes.literal(caption, caption))
        container += block
        return [container]

    def output(self, text: str) -> list[nodes.Node]:
        """What was printed, if it is to be shown."""
        lines = [line.rstrip() for line in text.rstrip().splitlines()]
        if not lines or "hide-output" in self.options:
            return []
        if len(lines) > MAX_LINES:
            raise self.error(f"prints {len(lines)} lines; show fewer")
        shown = "\n".join(lines).replace(str(self.page.folder) + "/", "")
        is_message = self.options.keys() & {"fails", "wrap"}  # long lines are wrapped
        classes = ["output", "message"] if is_message else ["output"]
        return [nodes.literal_block(shown, shown, language="text", classes=classes)]

    def picture(self, suffix: str) -> Path:
        """Path of the next picture of the page, in the source folder."""
        self.page.pictures += 1
        name = f"{self.env.docname.replace('/', '-')}-{self.page.pictures}{suffix}"
        path = Path(self.env.srcdir) / "_run" / name
        path.parent.mkdir(exist_ok=True)
        return path

    def image(self, path: Path) -> nodes.Node:
        """A picture of the page."""
        uri = f"/_run/{path.name}"
        node = nodes.image(uri=uri, alt=self.options.get("alt", ""), classes=["figure"])
        if "width" in self.options:
            node["width"] = self.options["width"]
        relative, _ = self.env.relfn2path(uri)
        node["uri"] = "/" + relative
        return node


class Run(RunBase):
    """Python code."""

    def run(self):
        """Run the code; show it, its output and its figures."""
        source = "\n".join(self.content)
        with _inside(self.page) as stream:
            try:
                value = self.execute(source)
            except Exception as error:
                if "fails" not in self.options:
                    raise self.error(f"{type(error).__name__}: {error}\n{source}") from error
                print(f"{type(error).__name__}: {error}")
                value = None
            else:
                if "fails" in self.options:
                    raise self.error(f"raises nothing\n{source}")
            figures = self.figures(value)
            if value is not None and not figures:
                print(value if isinstance(value, str) else repr(value))
        shown = [] if "hide-code" in self.options else self.code(source, "python")
        shown += self.output(stream.getvalue())
        for figure in figures:
            path = self.picture(".png")
            figure.savefig(path, dpi=150, bbox_inches="tight")
            shown.append(self.image(path))
        return shown

    def execute(self, source: str):
        """Value of the last expression, None if there is none."""
        tree = ast.parse(source)
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        names = self.page.names
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.simplefilter("ignore", ResourceWarning)  # files of one line of code
            exec(compile(tree, self.env.docname, "exec"), names)
            if last is not None:
                return eval(compile(ast.Expression(last.value), self.env.docname, "eval"), names)
        return None

    def figures(self, value) -> list:
        """Figures to show: that which the code returns, and those that pyplot has open."""
        from matplotlib import pyplot
        from matplotlib.figure import Figure

        found = [pyplot.figure(number) for number in pyplot.get_fignums()]
        pyplot.close("all")
        if isinstance(value, Figure) and value not in found:
            found.append(value)
        return found


class RunCommand(RunBase):
    """Commands `jaxbeam ...`, run in this process."""

    def run(self):
        """Run the commands; show them and what they print."""
        from jaxbeam.cli import main

        text = "\n".join(self.content)
        lines = text.replace("\\\n", " ").splitlines()
        with _inside(self.page) as stream:
            for line in lines:
                program, *arguments = shlex.split(line, comments=True) or [""]
                if not program:
                    continue
                if program != "jaxbeam":
                    raise self.error(f"only commands `jaxbeam` can run: {line}")
                status = None
                shown_warning = warnings.showwarning
                try:
                    main(arguments)
                except SystemExit as ended:
                    status = ended.code
                finally:
                    warnings.showwarning = shown_warning
                if bool(status) != ("fails" in self.options):
                    raise self.error(f"status {status}: {line}\n{stream.getvalue()}")
        shown = [] if "hide-code" in self.options else self.code(text, "console")
        return shown + self.output(stream.getvalue())


class Write(RunBase):
    """A file of the page."""

    required_arguments = 1

    def run(self):
        """Write the file into the folder of the page, and show it."""
        (name,) = self.arguments
        text = "\n".join(self.content)
        path = self.page.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")
        if "hide-code" in self.options:
            return []
        languages = {".toml": "toml", ".py": "python"}
        return self.code(text, languages.get(path.suffix, "text"), caption=name)


class Show(RunBase):
    """A picture that was written into the folder of the page."""

    required_arguments = 1
    has_content = False

    def run(self):
        """Show the picture."""
        written = self.page.folder / self.arguments[0]
        if not written.exists():
            raise self.error(f"nothing has written {written.name}")
        path = self.picture(written.suffix)
        shutil.copyfile(written, path)
        return [self.image(path)]


def _remove_folder(app, docname, source=None):
    """Remove the folder of a page that has been read."""
    for page in app.env.temp_data.get("run_pages", {}).values():
        shutil.rmtree(page.folder, ignore_errors=True)


def setup(app):
    """Register the directives."""
    app.add_directive("run", Run)
    app.add_directive("run-command", RunCommand)
    app.add_directive("write", Write)
    app.add_directive("show", Show)
    app.connect("doctree-read", lambda app, _: _remove_folder(app, app.env.docname))
    sys.modules.setdefault("run_code", sys.modules[__name__])
    return {"parallel_read_safe": False}
