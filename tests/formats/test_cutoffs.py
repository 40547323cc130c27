import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fragprune_plugins.errors import InputError
from fragprune_plugins.workbench.models.cutoffs import STEP, decode, encode

ALL = np.arange(256, dtype=np.uint8)


def test_codes_are_the_powers_that_the_specification_names():
    wanted = [255 ** -(1 - c / 256) for c in range(256)]
    np.testing.assert_allclose(decode(ALL), wanted, rtol=1e-6)
    assert decode(ALL).dtype == np.float32


def test_decoding_and_encoding_gives_each_code_back_in_its_place():
    square = torch.from_numpy(decode(ALL)).reshape(16, 16)
    assert np.array_equal(encode(square), ALL.reshape(16, 16))
    assert (np.diff(decode(ALL)) > 0).all()


@pytest.mark.parametrize(
    ("tau", "code"), [(0.0, 0), (9e-14, 0), (1 / 255, 0), (0.98, 255), (1.0, 255), (255**-0.5, 128)]
)
def test_ends_and_middle(tau, code):
    assert encode([tau]).tolist() == [code]


@given(st.floats(1 / 255, 255 ** (-1 / 512)))
def test_error_is_at_most_half_a_step_of_q(tau):
    back = float(decode(encode(tau)))
    assert abs(-2 * math.log(back) + 2 * math.log(tau)) <= STEP / 2 + 1e-6
    assert back == pytest.approx(tau, rel=0.011)


@given(st.floats(0, 1), st.floats(0, 1))
def test_codes_keep_the_order(one, other):
    low, high = encode(sorted([one, other]))
    assert low <= high


@pytest.mark.parametrize("wrong", [math.nan, -0.1, 1.1, math.inf])
def test_what_is_no_threshold_is_refused(wrong):
    with pytest.raises(InputError, match="outside"):
        encode([0.5, wrong])
