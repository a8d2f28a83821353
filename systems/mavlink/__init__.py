"""MAVLink: the boundary where NED/FRD, PWM and message units live."""
