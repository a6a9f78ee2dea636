"""Images that show nothing are told by the percentiles of their grey levels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.stereo.blank import STEP_PX, blank_reason

RNG = np.random.default_rng(0)


@given(st.integers(0, 2**32 - 1), st.integers(0, 255), st.integers(0, 12), st.sampled_from([1, 3]))
def test_the_levels_are_those_of_numpys_percentiles(seed, low, span, colours):
    random = np.random.default_rng(seed)
    size = (*random.integers(1, 40, 2), colours)[: 2 if colours == 1 else 3]
    image = np.minimum(random.integers(low, low + span + 1, size), 255).astype(np.uint8)
    two, other = np.percentile(image[::STEP_PX, ::STEP_PX], (2, 98))
    reason = blank_reason(image)
    assert (reason is None) == (other > 8 and two < 250 and other - two > 3)
    if reason is not None:
        assert f"({two:.0f} to {other:.0f} of 255)" in reason


@pytest.mark.parametrize(("level", "what"), [(3, "black"), (254, "white"), (120, "one grey")])
def test_one_level_is_named(level, what):
    image = np.full((40, 60), level, np.uint8)
    image[0, 0] = 128
    assert what in str(blank_reason(image))
    assert blank_reason(RNG.integers(0, 256, (40, 60, 3), np.uint8)) is None
