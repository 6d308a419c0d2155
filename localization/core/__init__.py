"""State of the filter, the functions that change it, and the measurements that update it."""
