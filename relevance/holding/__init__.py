"""How the hand takes boxes and what is in its way: what planner and networks both go by.

Import its files by name: those with kernels load a compiler.
"""
