"""League: skidloc and its peers on the same logs, judged by outside tools. See `python -m tests.league --help`."""
