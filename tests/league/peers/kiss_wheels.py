"""KISS-ICP with its defaults, each registration started from wheel odometry."""

from __future__ import annotations

from exchange import run
from kiss import register

if __name__ == "__main__":
    run(lambda drive: register(drive, drive.predictions()))
