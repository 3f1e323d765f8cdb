"""One model file, read by both packages."""

import json

import numpy as np
import pytest
from safetensors.numpy import save_file

from jaxrender.harmonics import pose_model
from tests.support.asserts import assert_close, leaves
from tests.support.cases import POSE_MODEL
from tests.twins import both
from torchref.harmonics import pose_model as twin


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_both_packages_read_the_same_model(tmp_path, dtype):
    model = both.record(POSE_MODEL, "jaxrender", np.float32)
    arrays = pose_model.model_arrays(model)
    arrays = {k: x.astype(dtype) if x.dtype == np.float32 else x for k, x in arrays.items()}
    header = {
        "format": pose_model.FORMAT,
        "version": pose_model.FORMAT_VERSION,
        "feature_kind": model.features.kind,
        "feature_size": model.features.size,
    }
    path = tmp_path / "model.safetensors"
    save_file(arrays, path, metadata={"header": json.dumps(header)})
    (ours, our_header), (theirs, their_header) = pose_model.load_pose_model(path), twin.load_pose_model(path)
    assert our_header == their_header == header
    assert (ours.features.kind, ours.features.size) == (theirs.features.kind, theirs.features.size)
    arrays_of = [
        {name: x for name, x in leaves(m) if name not in (".features.kind", ".features.size")} for m in (ours, theirs)
    ]
    assert {k: x.dtype for k, x in arrays_of[0].items()} == {k: x.dtype for k, x in arrays_of[1].items()}
    assert_close(*arrays_of, ulps=0)
