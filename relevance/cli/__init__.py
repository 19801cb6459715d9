"""The `relevance` command: one subcommand a stage, flags derived from the types.

`relevance --help` stays quick, since each subcommand imports what it needs only when it is the
one. What becomes of an error is decided here alone: what the user can mend (a RelevanceError, a
file or a disk that refuses) is one line on stderr and exit code 2; anything else is a fault of
this project, a traceback that says so and exit code 70.
"""

from __future__ import annotations

import functools
import io
import itertools
import os
import select
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, suppress

import tyro

from relevance.cli.arguments import Command, one_of
from relevance.cli.commands import COMMANDS
from relevance.cli.terminal import UsageError, say
from relevance.errors import RelevanceError, RelevanceWarning

FAULT = 70
"""Exit code of a fault of this project (EX_SOFTWARE of sysexits.h)."""
CODES = (
    "exit codes: 0 done, 1 a check failed, a replay refused a plan or a trial a contender,\n"
    "2 you can mend it (one line says what), 130 interrupted,\n"
    f"{FAULT} a fault of relevance: please report its traceback"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a subcommand; returns its exit code (see CODES)."""
    _open_streams()
    name, *rest = [*(sys.argv[1:] if arguments is None else arguments)] or ["--help"]
    try:
        try:
            with warnings.catch_warnings():
                _tell_warnings(name)
                return _run(name, rest)
        finally:
            sys.stdout.flush()
    except KeyboardInterrupt:
        say("interrupted; what was finished stays, the same command goes on from there")
        return 130
    except BrokenPipeError as error:
        _drop_output()
        if _nobody_reads():  # `relevance sql ... | head`
            return 0
        return _refuse(name, error)
    except (OSError, RelevanceError) as error:
        if isinstance(error, OSError):
            _drop_output()
        return _refuse(name, error)
    except Exception:
        return _report()


def _run(name: str, rest: list[str]) -> int:
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
    if targets:  # `relevance bench planner`: two words name one command
        name, *rest = f"{name} {rest[0]}", *rest[1:]
    if name not in COMMANDS:
        known = ", ".join(targets or COMMANDS)
        raise UsageError(f"unknown command {name!r}, expected one of {known}")
    command = COMMANDS[name]
    decided = (_value(rest, flag) for flag in command.decides)
    run = command.make(_preset(rest, command), *decided)
    about = "\n".join([(run.__doc__ or "").partition("Args:")[0].strip(), "", "examples:"])
    about += "".join(f"\n  {example}" for example in command.examples)
    return _parse(name, run, f"{about}\n\n{CODES}", rest)()


def _parse(name: str, run: Callable[..., int], about: str, rest: list[str]) -> Callable[[], int]:
    """The command with its flags; tyro's page about a wrong flag becomes one line."""
    wrong = io.StringIO()
    try:
        with redirect_stderr(wrong):
            return tyro.cli(
                functools.wraps(run)(lambda **given: functools.partial(run, **given)),
                prog=f"relevance {name}",
                description=about,
                args=rest,
            )
    except SystemExit as end:
        if end.code in (None, 0):
            raise
        raise UsageError(f"{_first(wrong.getvalue())}; see relevance {name} --help") from None


def _first(page: str) -> str:
    """What a page of tyro says first: between its first two rules, drawn as stderr allows."""
    lines = [line.strip(" │╭╮╰╯") for line in page.splitlines()]
    rules = [number for number, line in enumerate(lines) if "──" in line or "---" in line]
    said = lines[rules[0] + 1 : rules[1]] if len(rules) > 1 else lines
    return " ".join(" ".join(said).split())


def _preset(arguments: Sequence[str], command: Command) -> str:
    """The preset on the command line, read first since the other defaults depend on it."""
    value = _value(arguments, "--preset")
    one_of("--preset", value, command.presets)
    return command.preset if value is None else value


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
    lines += ["", "examples:", *(f"  {c.examples[0]}" for c in commands.values()), "", CODES]
    return "\n".join(lines)


# --- what becomes of an error ------------------------------------------------------------


def _refuse(name: str, error: Exception) -> int:
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        files = [str(file) for file in (error.filename, error.filename2) if file is not None]
        text = ": ".join([*files, error.strerror])
    say(f"relevance {name}: {' '.join(text.split())}")
    return 2


def _report() -> int:
    traceback.print_exc()
    say("this is a fault of relevance, not of yours: please report it with the lines above")
    return FAULT


def _tell_warnings(name: str) -> None:
    """Print this project's own warnings as one line each, and leave the others as they are."""
    show = warnings.showwarning

    def tell(message: Warning | str, category: type[Warning], *where: object) -> None:
        if issubclass(category, RelevanceWarning):
            say(f"relevance {name}: warning: {' '.join(str(message).split())}")
        else:
            show(message, category, *where)  # pyright: ignore[reportArgumentType]

    warnings.simplefilter("always", RelevanceWarning)
    warnings.showwarning = tell  # pyright: ignore[reportAttributeAccessIssue]


def _open_streams() -> None:
    """Give a process that was started without a standard stream one that leads nowhere, and escape
    what a locale cannot write.

    Else the next file that is opened would take its number, and get what is printed.
    """
    for number, mode, name in ((0, "r", "stdin"), (1, "w", "stdout"), (2, "w", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
            setattr(sys, name, os.fdopen(number, mode, closefd=False))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _nobody_reads() -> bool:
    poll = select.poll()
    for stream in (1, 2):
        poll.register(stream, 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _drop_output() -> None:
    """Lead away what stdout still holds when it cannot be written, as the end would try again."""
    with suppress(OSError, ValueError):
        try:
            sys.stdout.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
