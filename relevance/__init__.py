"""Datasets, models and guides that tell a task-and-motion planner which objects matter."""
