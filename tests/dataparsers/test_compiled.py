from __future__ import annotations

import numpy as np

from enerf_ns.dataparsers.compiled import compiled


def _total(values, scale):
    total = 0.0
    for value in values:
        total += scale * value
    return total


def test_a_compiled_function_gives_what_python_gives():
    values = np.random.default_rng(0).normal(size=100)
    assert compiled(_total)(values, 3.0) == _total(values, 3.0)


def test_it_is_compiled_once():
    assert compiled(_total) is compiled(_total)


def test_it_divides_as_numpy_does():
    def ratio(a, b):
        return a / b

    assert compiled(ratio)(1.0, 0.0) == np.inf
