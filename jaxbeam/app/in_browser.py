"""Answers to the page that runs without a server: Python itself is in the browser (`worker.js`)."""

from pathlib import Path

from jaxbeam.app.questions import answer, questions
from jaxbeam.app.workspace import Workspace
from jaxbeam.model.plausibility.check import leave_warnings_to_caller

FOLDER = Path("cases")  # of the file system that the browser forgets


class Page:
    """The page of a folder, with the question by name and JSON, and the answer as bytes."""

    def __init__(self, folder: Path = FOLDER):
        folder.mkdir(exist_ok=True)
        leave_warnings_to_caller()  # the page shows them
        self._workspace = Workspace(folder)
        self._questions = questions(self._workspace)

    def ask(self, name: str, text: str) -> tuple[bool, bytes, str, str]:
        """Whether it was answered, the answer or the problem, its media type, and a file's name."""
        answered, content = answer(self._questions[name], text)
        return answered, content.body, content.kind, content.name or ""

    def close(self) -> None:
        """Forget logs and work."""
        self._workspace.close()
