"""Every subcommand by name, in the order of the overview: one file a group.

A command is a maker and an entry of its group's COMMANDS. The maker returns a typed function,
from which tyro derives the flags; it imports only what its own flags need, and the function
imports the rest when it runs.
"""

from relevance.cli import (
    asking,
    benchmarks,
    champions,
    learning,
    making,
    planning,
    predicting,
    reproducing,
    running,
    sharing,
    studies,
    viewing,
)
from relevance.cli.arguments import Command

COMMANDS: dict[str, Command] = {
    name: command
    for group in (
        making,
        learning,
        studies,
        champions,
        planning,
        viewing,
        predicting,
        asking,
        reproducing,
        sharing,
        running,
        benchmarks,
    )
    for name, command in group.COMMANDS.items()
}
