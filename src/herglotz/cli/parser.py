"""The argument parser: one subparser a subcommand, one line for a usage error."""

from __future__ import annotations

import argparse
import re
import textwrap
from typing import NoReturn

import herglotz
from herglotz.cli import export, fit, plot, predict, report, rollout, select, simulate, trust, tune, verify

DESCRIPTION = """\
Learn a discrete contact Lagrangian from measured positions, step it, and prove that it is a contact integrator.

  herglotz simulate damped_pendulum --out pendulum.csv     data with a known answer (or bring your own csv)
  herglotz fit pendulum.csv --out runs/pendulum            train; metrics and figures land in the folder
  herglotz verify runs/pendulum                            check every identity, exit code 1 if one fails
  herglotz report runs/pendulum                            one HTML page: the equation, errors, whether to believe it
  herglotz export runs/pendulum --out pendulum.pt2         one file that steps with PyTorch alone
"""
NEGATIVE_NUMBER = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")  # argparse takes -1e-3 for an option


class Help(argparse.RawDescriptionHelpFormatter):
    """Help as wide as the terminal: paragraphs are wrapped, lists and examples (indented lines) stay."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = [
            part if "\n " in f"\n{part}" else textwrap.fill(" ".join(part.split()), width)
            for part in text.strip("\n").split("\n\n")
        ]
        return "\n\n".join(textwrap.indent(part, indent) for part in paragraphs)


class Parser(argparse.ArgumentParser):
    """An `ArgumentParser` whose errors are one line."""

    def __init__(self, *args, **options):
        super().__init__(*args, formatter_class=Help, **options)
        self._negative_number_matcher = NEGATIVE_NUMBER

    def error(self, message: str) -> NoReturn:
        """Print the mistake and where to read on; exit with code 2."""
        self.exit(2, f"herglotz: error: {' '.join(message.split())}; see '{self.prog} --help'\n")


def build_parser() -> Parser:
    """Return the parser of the whole command line; `arguments.run(arguments)` does the work."""
    parser = Parser(prog="herglotz", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"herglotz {herglotz.__version__}")
    commands = parser.add_subparsers(title="subcommands", metavar="COMMAND", required=True)
    for module in (simulate, fit, select, predict, rollout, export, verify, trust, report, tune, plot):
        module.add(commands)
    return parser
