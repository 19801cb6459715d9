"""The error that every mistake of a user becomes: one line that says what, where, what instead."""

from __future__ import annotations


class RelevanceError(ValueError):
    """Input that cannot be used; its message is one line for the person who gave it.

    The command line prints that line and exits with 2. Anything else that is raised is a fault
    of this project.
    """


class RelevanceWarning(UserWarning):
    """Input that is used although its answer may mislead; one line that says why."""
