"""jaxrender.pathtrace and jaxrender.vec3 against the twin, kernel by kernel."""

import pytest

from tests.twins.agreement import cases_of, check


@pytest.mark.parametrize(("case", "dtype"), cases_of("vec3.", "pathtrace."))
def test_twin(case, dtype):
    check(case, dtype)
