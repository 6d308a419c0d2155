"""Settings of all tests."""

import os

from hypothesis import settings

# The same examples in every run, so that a failure is a change's and not the day's; HYPOTHESIS_EXPLORE=1 looks for new ones.
settings.register_profile("reproducible", derandomize=True)
if not os.environ.get("HYPOTHESIS_EXPLORE"):
    settings.load_profile("reproducible")
