"""jaxrender.harmonics against the twin, kernel by kernel: values and derivatives."""

import pytest

from tests.twins.agreement import cases_of, check


@pytest.mark.parametrize(("case", "dtype"), cases_of("harmonics."))
def test_twin(case, dtype):
    check(case, dtype)
