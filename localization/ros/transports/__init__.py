"""Transports: bytes of topics in and out of a robot's network, one module each."""
