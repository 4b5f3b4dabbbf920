"""Answers to the page that runs without a server: Python itself is in the browser (`worker.js`)."""

from pathlib import Path

from jaxbeam.app.questions import answer, questions
from jaxbeam.app.workspace import Workspace
from jaxbeam.model.plausibility.check import leave_warnings_to_caller

FOLDER = Path("cases")  # of the file system that the browser forgets


class Page:
    """Page of a folder: takes questions by name and JSON, returns answers as bytes."""

    def __init__(self, folder: Path = FOLDER):
        folder.mkdir(exist_ok=True)
        leave_warnings_to_caller()  # the page shows them
        self._workspace = Workspace(folder)
        self._questions = questions(self._workspace)

    def ask(self, name: str, text: str) -> tuple[bool, bytes, str, str]:
        """Whether a question was answered, the answer or problem, its media type, a file name."""
        answered, content = answer(self._questions[name], text)
        return answered, content.body, content.kind, content.name or ""

    def close(self) -> None:
        """Cancel all work and remove the logs."""
        self._workspace.close()
