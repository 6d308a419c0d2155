"""What tests beside real peers share."""

import pytest


@pytest.fixture
def running():
    """Processes are added; what still runs at the end is killed."""
    processes = []
    yield lambda process: processes.append(process) or process
    for process in processes:
        if process.process.poll() is None:
            process.kill()
