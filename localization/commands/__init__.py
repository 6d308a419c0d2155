"""The commands of `skidloc`, one module each: a frozen dataclass whose fields are the options, with `run(console)`."""
