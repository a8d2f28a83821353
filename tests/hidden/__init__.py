"""The truth that the diagnosis must find: a simulator of its own, for tests alone (see README.md).

NumPy in float64, no import of the package under test. Arrays are component first, runs last:
(3, B) vectors, (4, B) quaternions w x y z (body to world). W: z up, 0 at the surface; B: forward,
left, up.
"""
