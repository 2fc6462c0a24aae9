"""The argument parser: a subparser a subcommand, and one line for a usage error."""

from __future__ import annotations

import argparse
import re
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

import herglotz
from herglotz.cli import export, fit, plot, predict, report, rollout, select, simulate, trust, tune, verify
from herglotz.cli.common import Flag, complain
from herglotz.errors import did_you_mean

DESCRIPTION = """\
From recorded positions to the equation of motion (a learned discrete contact Lagrangian), a fast time stepper, and a
statement whether to believe it.

Data with a known answer (or bring your own csv):
  herglotz simulate damped_pendulum --out pendulum.csv
Fit; equation and verdict are printed, figures land in the folder:
  herglotz fit pendulum.csv --out runs/pendulum
One HTML page: the equation, errors, whether to believe it:
  herglotz report runs/pendulum
Check every identity, exit code 1 if one fails:
  herglotz verify runs/pendulum
One file that steps with PyTorch alone:
  herglotz export runs/pendulum --out pendulum.pt2
"""
# argparse's own pattern has no exponents: argparse takes -1e-3 for an option.
NEGATIVE_NUMBER = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")


class Help(argparse.RawDescriptionHelpFormatter):
    """Help as wide as the terminal: paragraphs are wrapped, and indented lines (lists, examples) stay lines."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = [
            "\n".join(_item(line, width) for line in part.splitlines())
            if "\n " in f"\n{part}"
            else textwrap.fill(" ".join(part.split()), width)
            for part in text.strip("\n").split("\n\n")
        ]
        return "\n\n".join(textwrap.indent(part, indent) for part in paragraphs)


def _item(line: str, width: int) -> str:
    """A line of a list, continued under its second column; a command is continued after a backslash."""
    if len(line) <= width:
        return line
    if line.lstrip().startswith("herglotz "):
        # A flag and its value stay on one line.
        words = re.sub(r"(--\S+) (?=[^-])", "\\1\x00", line)
        return " \\\n".join(textwrap.wrap(words, width - 2, subsequent_indent=" " * 6, break_on_hyphens=False)).replace(
            "\x00", " "
        )
    column = re.match(r" *(\S+ {2,})?", line)
    return textwrap.fill(line, width, subsequent_indent=" " * (column.end() if column else 0))


class Parser(argparse.ArgumentParser):
    """An `ArgumentParser` whose errors are one line."""

    def __init__(self, *args, **options):
        super().__init__(*args, formatter_class=Help, **options)
        self._negative_number_matcher = NEGATIVE_NUMBER

    def format_help(self) -> str:
        """Format the help; a description that is a function is called first."""
        if callable(self.description):
            self.description = self.description()
        return super().format_help()

    def parse_known_args(self, args=None, namespace=None):
        """Parse; refuse unknown arguments here, so that the message names the subcommand's help."""
        found, rest = super().parse_known_args(args, namespace)
        if rest:
            near = did_you_mean(rest[0], self._option_string_actions)
            files = "; several recordings: name the folder they are in" if Path(rest[0]).exists() else near
            self.error(f"unrecognized arguments: {' '.join(rest)}{files}")
        return found, rest

    def error(self, message: str) -> NoReturn:
        """Print the mistake and the command for help; exit with code 2."""
        if wrong := re.search(r"invalid choice: '(.*)' \(choose from (.*)\)$", message):
            message += did_you_mean(wrong[1], re.findall(r"[\w-]+", wrong[2]))
        complain(f"error: {message}; see '{self.prog} --help'".replace("?; see", "? See"))
        self.exit(2)


def build_parser() -> Parser:
    """Return the parser of the whole command line; `arguments.run(arguments)` does the work."""
    parser = Parser(prog="herglotz", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"herglotz {herglotz.__version__}")
    commands = parser.add_subparsers(title="subcommands", metavar="COMMAND", required=True)
    for module in (simulate, fit, select, predict, rollout, export, verify, trust, report, tune, plot):
        own = vars(module)
        command = commands.add_parser(
            module.__name__.rpartition(".")[2], help=module.HELP, description=own.get("DESCRIPTION"),
            usage=own.get("USAGE"),
        )  # fmt: skip
        _add(command, module.FLAGS)
        command.set_defaults(run=module.run)
    return parser


def _add(command: argparse.ArgumentParser, flags: Iterable[Flag | str]) -> None:
    """Add the flags of a command; a text among the flags is the title of the next group."""
    place: argparse._ActionsContainer = command
    for one in flags:
        if isinstance(one, str):
            place = command.add_argument_group(one)
        else:
            names, options = one
            place.add_argument(*names, **options)
