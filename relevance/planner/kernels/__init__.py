"""Inner loops: box distances, the arm's kinematics, native calls and linear algebra, in numba."""
