"""The modules under the rooms of jaxrender against the twin, kernel by kernel: values and derivatives."""

import pytest

from tests.twins.agreement import cases_of, check


@pytest.mark.parametrize(("case", "dtype"), cases_of("vecmath.", "camera.", "latlong.", "metrics.", "scene."))
def test_twin(case, dtype):
    check(case, dtype)
