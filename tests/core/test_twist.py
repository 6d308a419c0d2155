"""The twist at the end of a step: never exact, and with the gyro's rate where there is one."""

from __future__ import annotations

import numpy as np
import pytest

from localization.core.twist import fuse_turn, twist_at_end


def test_twist_at_end_is_never_exact_and_takes_the_gyros_rate():
    still, cov = twist_at_end(np.zeros(3), np.zeros((3, 3)), np.zeros(3), 0.1)
    assert not still.any()
    assert (np.sqrt(np.diagonal(cov)) >= 2e-3).all()
    mean, change = np.array([0.5, 0.0, 0.3]), np.array([0.1, 0.0, 0.2])
    twist, cov = twist_at_end(mean, np.diag([1e-2, 1e-2, 4e-2]), change, 0.1)
    assert twist == pytest.approx(mean + change)
    assert cov[2, 2] == pytest.approx(4e-3 + 1e-2 + 4e-6)
    fused, fused_cov = fuse_turn(twist, cov, 0.6, 1e-4)
    assert fused[2] == pytest.approx(0.6, abs=2e-3)
    assert 0.0 < fused_cov[2, 2] < 1e-4
