"""Inner loops: box distances, native calls and the solvers' linear algebra, in numba."""
