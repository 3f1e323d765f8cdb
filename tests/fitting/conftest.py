import pytest

from tests.fitting.made_up import made_up_data


@pytest.fixture(scope="module")
def data():
    return made_up_data()
