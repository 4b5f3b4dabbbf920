"""Types and shapes: those that checkers of a user's program find, and those checked while testing.

Signatures are checked while testing: shapes, names of axes, types, fields of dataclasses.
"""

import dataclasses
import json
import os
import subprocess
import sys

import jax.numpy as jnp
import pytest
from beartype import beartype
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Array, Float

from jaxbeam.model.load_set import LoadSet
from jaxbeam.numerics.riccati import care
from tests import shape_checks
from tests.modules import DATA, PACKAGES, ROOT

CONSUMER = (DATA / "consumer.py").read_text(encoding="utf-8")
WRONG = {
    "record.deflexion": "attribute",
    "jb.simulat(case)": "attribute",
    "jb.simulate(3.0)": "argument",
    "tuning.read_log(3.0)": "argument",
    "fit.verdict + 1": "operand",
    "jb.Beam(lenght=1.0)": "argument",
}


def mypy(folder) -> dict[int, str]:
    """Complaints of mypy about `consumer.py` of a folder, by lines."""
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--output=json", "consumer.py"],
        cwd=folder,
        env=os.environ | {"MYPYPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    found = map(json.loads, done.stdout.splitlines())
    return {one["line"]: one["message"] for one in found}


def pyright(folder) -> dict[int, str]:
    """Complaints of pyright about `consumer.py` of a folder, by lines."""
    (folder / "pyrightconfig.json").write_text(json.dumps({"extraPaths": [str(ROOT)]}))
    done = subprocess.run(
        [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    found = json.loads(done.stdout)["generalDiagnostics"]
    return {one["range"]["start"]["line"] + 1: one["message"] for one in found}


@pytest.mark.parametrize("checker", [mypy, pyright])
def test_a_typed_program_is_accepted_and_its_faults_are_found(tmp_path, checker):
    """One run: lines that are right have no complaint, those of `WRONG` have one each."""
    pytest.importorskip(checker.__name__, reason="a checker of types, in the group dev")
    (tmp_path / "consumer.py").write_text(CONSUMER + "\n".join(WRONG) + "\n")
    first = len(CONSUMER.splitlines()) + 1
    complaints = checker(tmp_path)
    assert sorted(complaints) == list(range(first, first + len(WRONG))), complaints
    for message, word in zip(complaints.values(), WRONG.values(), strict=True):
        assert word in message.lower() or checker is pyright


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_say_that_they_are_typed(package):
    assert (ROOT / package / "py.typed").exists()


checked = shape_checks.checked(typechecker=beartype)


@checked
def product(a: Float[Array, "row n"], b: Float[Array, "n column"]) -> Float[Array, "row column"]:
    return a @ b


@checked
def square(a: Float[Array, " n"]) -> Float[Array, "n n"]:
    return product(a[:, None], a[None]) if a[0] else a


@checked
@dataclasses.dataclass
class Row:
    entries: Float[Array, " n"]

    @property
    @checked
    def sum(self) -> Float[Array, ""]:
        return self.entries


def test_an_axis_has_one_size_in_a_call_and_any_in_another():
    assert product(jnp.ones((2, 3)), jnp.ones((3, 1))).shape == (2, 1)
    assert square(jnp.ones(3)).shape == (3, 3) and square(jnp.ones(4)).shape == (4, 4)


@pytest.mark.parametrize(
    "call",
    [
        lambda: product(jnp.ones((2, 3)), jnp.ones((2, 1))),
        lambda: square(jnp.zeros(3)),
        lambda: Row(jnp.ones((2, 2))),
        lambda: Row(jnp.ones(2)).sum,
        lambda: care(jnp.eye(2), jnp.eye(2), jnp.eye(3), jnp.eye(2)[0]),
    ],
    ids=["arguments", "result", "field", "property", "function of the library"],
)
def test_other_shapes_are_refused(call):
    with pytest.raises(BeartypeCallHintViolation):
        call()


def test_of_many_calls_some_are_checked():
    refused = 0
    for _ in range(1000):
        try:
            square(jnp.zeros(3))
        except BeartypeCallHintViolation:
            refused += 1
    assert refused == 50 + 10


def test_computed_sizes_are_checked():
    """Sizes in braces are those of the arguments, which only jaxtyping's own wrapper knows."""

    @checked
    def first(a: Float[Array, " n"], count: int) -> Float[Array, "{count}"]:
        return a[:2]

    assert first(jnp.ones(3), 2).shape == (2,)
    with pytest.raises(Exception, match="return value"):
        first(jnp.ones(3), 3)
    assert "{" in str(
        LoadSet.passages.__annotations__["return"]
    )  # else the library needs none of this


def test_types_by_name_may_be_unknown():
    """Of those that are imported for type checkers only, nothing is checked."""

    @checked
    def one(a: "Later", b: list["Later"]) -> Float[Array, " n"]:  # pyright: ignore
        return a

    assert one(jnp.ones(3), [1]).shape == (3,)
    with pytest.raises(Exception, match="return value"):
        one(jnp.ones((3, 3)), [1])
