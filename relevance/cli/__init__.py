"""The `relevance` command: one subcommand a stage, flags derived from the types.

`relevance --help` stays quick, since each subcommand imports what it needs only when it is the
one. Bad input (a ValueError that this project raised) is one line on stderr and exit code 2; a
dataset that breaks its contracts is exit code 1.
"""

from __future__ import annotations

import functools
import itertools
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import get_args

import tyro

from relevance.cli.arguments import Preset
from relevance.cli.commands import COMMANDS, Command
from relevance.cli.terminal import UsageError, say


def _ours(error: BaseException) -> bool:
    """Whether this project raised it, rather than a library that met a mistake of ours."""
    packages = ("relevance.", "flows.")
    if type(error).__module__.startswith(packages):
        return True
    trace, module = error.__traceback__, ""
    while trace is not None:
        module, trace = trace.tb_frame.f_globals.get("__name__", ""), trace.tb_next
    return f"{module}.".startswith(packages)


def _preset(arguments: Sequence[str], default: Preset) -> Preset:
    """The preset on the command line, read first since the other defaults depend on it."""
    known: dict[str, Preset] = {name: name for name in get_args(Preset)}
    value = _value(arguments, "--preset")
    if value is None:
        return default
    if value not in known:
        raise UsageError(f"--preset {value}: expected one of {', '.join(known)}")
    return known[value]


def _value(arguments: Sequence[str], flag: str) -> str | None:
    """What is given to a flag; None without it."""
    for argument, following in itertools.zip_longest(arguments, arguments[1:]):
        name, sign, inline = argument.partition("=")
        if name == flag:
            return inline if sign else following or ""
    return None


def _help(commands: Mapping[str, Command] = COMMANDS) -> str:
    width = max(map(len, commands))
    lines = ["usage: relevance COMMAND [options]; `relevance COMMAND --help` shows the options", ""]
    lines += [f"  {name:<{width}}  {command.about}" for name, command in commands.items()]
    lines += ["", "examples:", *(f"  {c.examples[0]}" for c in commands.values())]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a subcommand; returns its exit code (0, 1 for a failed check, 2 for bad input)."""
    name, *rest = [*(sys.argv[1:] if arguments is None else arguments)] or ["--help"]
    if name in ("-h", "--help", "help"):
        print(_help())
        return 0
    if name == "--version":
        from importlib.metadata import version

        print(f"relevance {version('relevance')}")
        return 0
    targets = {full: c for full, c in COMMANDS.items() if full.startswith(f"{name} ")}
    if targets and (not rest or rest[0] in ("-h", "--help")):  # `relevance bench`
        print(_help(targets))
        return 0
    try:
        if targets:  # `relevance bench planner`: two words name one command
            name, *rest = f"{name} {rest[0]}", *rest[1:]
        if name not in COMMANDS:
            known = ", ".join(targets or COMMANDS)
            raise UsageError(f"unknown command {name!r}, expected one of {known}")
        command = COMMANDS[name]
        decided = (_value(rest, flag) for flag in command.decides)
        run = command.make(_preset(rest, command.preset), *decided)
        about = "\n".join([(run.__doc__ or "").partition("Args:")[0].strip(), "", "examples:"])
        about += "".join(f"\n  {example}" for example in command.examples)
        ready: Callable[[], int] = tyro.cli(
            functools.wraps(run)(lambda **given: functools.partial(run, **given)),
            prog=f"relevance {name}",
            description=about,
            args=rest,
        )
        return ready()
    except ValueError as error:
        if not _ours(error):
            raise
        say(f"relevance {name}: {' '.join(str(error).split())}")
        return 2
    except KeyboardInterrupt:
        say("interrupted; what was finished stays, the same command goes on from there")
        return 130
    except BrokenPipeError:  # `relevance sql ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
