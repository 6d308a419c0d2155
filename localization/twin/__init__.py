"""A robot in the user's own simulator: what that simulator gets wrong against measured motion, why, and the file that is better.

`playback` runs windows of a drive in an engine, `discrepancy` compares them with what was measured, `parameters` lists the numbers of an
engine that move a robot, `fit` finds which of them are wrong, and `mend` writes the simulator that is better on windows held out.
"""
