"""The mixer of a real ArduSub 4.5.6, frame VECTORED_6DOF, as it showed on single thrusters."""

import numpy as np

# (forward, right, down | roll, pitch, yaw) of each thruster at PWM above 1500, as measured
MEASURED = np.array(
    [
        [-1, 1, 0, 0, 0, 1],
        [-1, -1, 0, 0, 0, -1],
        [1, 1, 0, 0, 0, -1],
        [1, -1, 0, 0, 0, 1],
        [0, 0, 1, 1, -1, 0],
        [0, 0, 1, -1, -1, 0],
        [0, 0, 1, 1, 1, 0],
        [0, 0, 1, -1, 1, 0],
    ]
)
