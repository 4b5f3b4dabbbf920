"""The C kernel of the benchmark finds the peaks of jaxbeam, since its method is the same."""

import numpy as np
import pytest

from experiments.benchmarks import kernel
from experiments.benchmarks.sweep import sweep_peaks


@pytest.mark.skipif(kernel.compiler() is None, reason="there is no C compiler")
def test_the_kernel_finds_the_peaks_of_jaxbeam(tmp_path):
    library = kernel.build(3, tmp_path)
    peaks = kernel.kernel_peaks(library, *kernel.kernel_arguments(3))
    assert np.max(np.abs(peaks / sweep_peaks(3) - 1)) < 1e-12
