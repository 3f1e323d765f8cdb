"""The pointwise pieces of jaxrender.pathtrace against the twin: values and derivatives."""

import pytest

from tests.twins.agreement import cases_of, check


@pytest.mark.parametrize(("case", "dtype"), cases_of("pathtrace."))
def test_twin(case, dtype):
    check(case, dtype)
