"""The C kernel that the benchmark compares with: the same method, so the same peaks."""

import numpy as np
import pytest

from experiments.benchmarks import kernel
from experiments.benchmarks.sweep import sweep_peaks


@pytest.mark.slow
@pytest.mark.skipif(kernel.compiler() is None, reason="there is no C compiler")
def test_the_kernel_finds_the_peaks_of_jaxbeam(tmp_path):
    found = kernel.peaks(kernel.build(3, tmp_path), *kernel.prepare(3))
    assert np.max(np.abs(found / sweep_peaks(3) - 1)) < 1e-12
