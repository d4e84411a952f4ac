"""The physics: pad frequencies to stress and gradient, and what is measured to get there.

numpy only (and transforms3d for rotations): no I/O, no clock, no ROS, no threads. What leaves this
folder as data is `FrequencyRows` and `StressRows`; what makes one of the other is `Reconstructor`.
"""
