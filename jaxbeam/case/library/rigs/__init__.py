"""Published rigs as case files, with the source of each number in a comment.

A and B: one span, with a shaker and with a patch; C: two spans with two patches; D: an example
from the literature. Where the thesis contradicts itself a comment names the value chosen. The
files may be copied and changed like any other case file.
"""

from importlib import resources

from jaxbeam.case.case import Case
from jaxbeam.files.case_file import load_case

RIG_NAMES = ("A", "B", "C", "D")


def load(name: str) -> Case:
    """Case of a published rig, "A", "B", "C" or "D"; raises ValueError for other names."""
    if name not in RIG_NAMES:
        raise ValueError(f"there is no published rig {name!r}; there are {', '.join(RIG_NAMES)}")
    with resources.as_file(resources.files(__name__) / f"{name}.toml") as path:
        return load_case(path)
