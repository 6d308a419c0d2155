"""Shapes of the arrays on public interfaces. All are float64; type checkers take them as `FloatArray`, readers as what they hold.

Arrays of poses and covariances have the same names where all leading axes are given in the docstring.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
"""Any shape; the docstring gives it."""
Pose2 = FloatArray
"""(3,) x, y, yaw [m, m, rad]: a pose or a motion of SE(2); its name reads ``world_T_body``."""
Twist2 = FloatArray
"""(3,) vx, vy, wz in the body frame [m/s, m/s, rad/s]."""
Tangent2 = FloatArray
"""(3,) of the Lie algebra se(2): a right perturbation or a residual [m, m, rad]."""
Cov3 = FloatArray
"""(3, 3) covariance of a `Tangent2` [m^2, m rad, rad^2]."""
Points2 = FloatArray
"""(N, 2) points of a plane [m]."""
