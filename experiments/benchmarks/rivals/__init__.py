"""The crossing of the speed benchmark solved by scipy, diffrax and numba."""

from experiments.benchmarks.common import import_optional

if import_optional("diffrax") is None:
    raise ImportError("this benchmark times diffrax: install it by `uv sync --extra benchmarks`")
