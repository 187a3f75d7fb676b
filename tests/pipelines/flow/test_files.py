"""The flow that comes with the sequence."""

from __future__ import annotations

import numpy as np

from pipelines.flow.files import FilesFlow


def test_given_flow_is_handed_on() -> None:
    gray = np.zeros((4, 6), np.uint8)
    given = np.ones((4, 6, 2), np.float32)
    assert FilesFlow().compute(gray, gray, given) is given
    assert FilesFlow().compute(gray, gray) is None
