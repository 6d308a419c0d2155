"""Which set-up is this log's? Every source of motion is a linear map of the body's twist at a delay; the most probable maps are inferred.

`infer_set_up` compares all sources of a log: wheels, driver's odometry, gyro with gravity, LiDAR, reference. Each module is one step:
`signals` (raw channels), `delays` (clocks), `alternatives` (what practice has in place of the robot file), `likelihood` (the robot's
motion integrated out), `search`, `refine`, `verdict`, `entrance`. See docs/theory/set-up.md.
"""

from localization.evidence.entrance import SetUpLog, infer_set_up, open_log_to_fit, open_log_with_set_up
from localization.evidence.verdict import Hypothesis, SetUp

__all__ = [
    "Hypothesis",
    "SetUp",
    "SetUpLog",
    "infer_set_up",
    "open_log_to_fit",
    "open_log_with_set_up",
]
